"""A run for rerun: frames, features, planes, axes, the map, the surface, and the estimate against the truth, on the timelines `frame` and `stamp`.

Needs the extra `view` (rerun-sdk). Images are the embedded frames, else the small ones that every recording holds."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from trihedron.pipeline.core.errors import DataError, UsageError
from trihedron.pipeline.core.types import Camera, Keypoints, ManhattanFrame, Map, Planes, Pose, Segments, Surface
from trihedron.pipeline.record.foxglove import View
from trihedron.pipeline.record.foxglove_messages import AXES, COLORS
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth
from trihedron.tools.export import Format
from trihedron.tools.recorded import references_of

CAMERA, IMAGE = "world/camera", "world/camera/image"
TOPICS = ("keypoints", "segments", "planes", "manhattan", "pose", "map", "surface")  # what is shown
MAP_EVERY = 10  # versions of the map; each is logged whole


def require_rerun() -> Any:
    """The module rerun. Raises UsageError when it is not installed."""
    if importlib.util.find_spec("rerun") is None:
        raise UsageError("rerun", "is not installed", "install it with: pip install trihedron[view]")
    import rerun

    return rerun


def write_rerun(recording: Recording, path: Path) -> str:
    """RRD: what `trihedron view` shows."""
    rerun = require_rerun()
    stream = rerun.RecordingStream("trihedron")
    stream.save(path)
    count = show(recording, stream)
    stream.flush()
    return f"{count} frames; open it with: rerun {path}"


def show(recording: Recording, stream: Any) -> int:
    """Log a run to a rerun stream; returns the number of frames. Raises DataError for a recording without frames."""
    import rerun

    references = references_of(recording)
    if not references:
        raise DataError(str(recording.path), "holds no frames", "record a run")
    stream.log("world", rerun.ViewCoordinates.RDF, static=True)
    _show_images(recording, stream)
    for topic in TOPICS:
        for number, value in enumerate(recording.values(topic) if topic in recording.topics else ()):
            if topic != "map" or number % MAP_EVERY == 0 or number + 1 == recording.counts["/map"]:
                _at(stream, value.index, value.stamp_ns)
                _SHOWN[topic](stream, value)
    _show_truth(recording, stream)
    return len(references)


def _at(stream: Any, index: int, stamp_ns: int) -> None:
    stream.set_time("frame", sequence=index)
    stream.set_time("stamp", duration=1e-9 * stamp_ns)


def _show_images(recording: Recording, stream: Any) -> None:
    """The images, and the camera that belongs to their size."""
    import rerun

    by_stamp = {reference.stamp_ns: reference for reference in references_of(recording).values()}
    if "dataset" in recording.topics:
        for value in recording.values("dataset"):
            _at(stream, value.index, value.stamp_ns)
            frame: Any = value
            _pinhole(stream, frame.camera, 1.0)
            stream.log(IMAGE, rerun.Image(frame.color).compress(jpeg_quality=85))
            stream.log(f"{CAMERA}/depth", rerun.DepthImage(frame.depth_m, meter=1.0))
        return
    for stamp_ns, data in recording.messages("/view/image"):
        reference = by_stamp[stamp_ns]
        _at(stream, reference.index, stamp_ns)
        _pinhole(stream, reference.camera, 0.5)
        stream.log(IMAGE, rerun.EncodedImage(contents=CompressedImage.FromString(data).data, media_type="image/jpeg"))


def _pinhole(stream: Any, camera: Camera, scale: float) -> None:
    import rerun

    K = camera.K.copy()
    K[:2, 2] = (K[:2, 2] + 0.5) * scale  # rerun's pixels begin at their corner
    K[[0, 1], [0, 1]] *= scale
    size = [round(camera.width * scale), round(camera.height * scale)]
    stream.log(IMAGE, rerun.Pinhole(image_from_camera=K, resolution=size, camera_xyz=rerun.ViewCoordinates.RDF))


def _show_keypoints(stream: Any, value: Keypoints) -> None:
    import rerun

    points = value.points_m[np.isfinite(value.points_m).all(axis=1)]
    stream.log(f"{CAMERA}/keypoints", rerun.Points3D(points, colors=(0, 230, 120), radii=rerun.Radius.ui_points(1.5)))


def _show_segments(stream: Any, value: Segments) -> None:
    import rerun

    ends = value.endpoints_m[np.isfinite(value.endpoints_m).all(axis=(1, 2))]
    stream.log(f"{CAMERA}/lines", rerun.LineStrips3D(ends, colors=(230, 50, 50)))


def _show_planes(stream: Any, value: Planes) -> None:
    import rerun

    points, colors = [], []
    for i, samples in enumerate(value.samples_m):
        points.append(samples[np.isfinite(samples[:, 0])])
        colors += [np.array(COLORS[i % len(COLORS)]) * 255] * len(points[-1])
    stacked = np.concatenate(points) if points else np.empty((0, 3))
    stream.log(f"{CAMERA}/planes", rerun.Points3D(stacked, colors=np.array(colors, np.uint8).reshape(-1, 3), radii=0.02))


def _show_axes(stream: Any, value: ManhattanFrame) -> None:
    import rerun

    axes = value.rotations[0].T if value.supported and len(value.rotations) else np.empty((0, 3))
    origins = np.tile([0.0, 0.0, 1.5], (len(axes), 1))
    stream.log(f"{CAMERA}/axes", rerun.Arrows3D(vectors=0.5 * axes, origins=origins, colors=(255 * np.array(AXES[: len(axes)])).astype(np.uint8)))


def _show_pose(stream: Any, value: Pose) -> None:
    import rerun

    T = value.T_world_camera
    stream.log(CAMERA, rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
    stream.log("world/path", rerun.Points3D([T[:3, 3]], colors=(220, 20, 60), radii=rerun.Radius.ui_points(2.0)))
    stream.log("status", rerun.TextLog(f"{value.status} {value.reason}", level="INFO" if value.status == "ok" else "WARN"))


def _show_map(stream: Any, value: Map) -> None:
    import rerun

    points = value.points.column("position_m")[value.points.column("alive")]
    stream.log("world/map/points", rerun.Points3D(points, colors=(140, 140, 140), radii=rerun.Radius.ui_points(1.5)))
    if len(value.lines):
        ends = value.lines.column("endpoints_m")[value.lines.column("alive")]
        stream.log("world/map/lines", rerun.LineStrips3D(ends, colors=(31, 119, 180)))
    for i in range(len(value.planes)):
        samples = value.planes.rows("samples_m", np.array([i]))[0]
        alive = bool(value.planes.rows("alive", np.array([i]))[0])
        shown = samples[np.isfinite(samples[:, 0])] if alive else samples[:0]
        color = np.array(255 * np.array(COLORS[i % len(COLORS)]), np.uint8)
        stream.log(f"world/map/planes/{i}", rerun.Points3D(shown, colors=color, radii=0.03))


def _show_surface(stream: Any, value: Surface) -> None:
    import rerun

    mesh = rerun.Mesh3D(vertex_positions=value.vertices_m, triangle_indices=value.triangles, vertex_colors=value.colors)
    stream.log("world/surface", mesh)


def _show_truth(recording: Recording, stream: Any) -> None:
    """The true path in the world of the run, and the error of each pose, as Foxglove's `/error`."""
    import rerun

    view = View(attached_truth(recording.attachments, str(recording.path)))
    true = []
    for value in recording.values("pose") if "pose" in recording.topics else ():
        found = dict(view.messages(value))
        if "/error" in found:
            _at(stream, value.index, value.stamp_ns)
            stream.log("error/position_m", rerun.Scalars(found["/error"].translation_m))
            stream.log("error/rotation_deg", rerun.Scalars(found["/error"].rotation_deg))
            place = found["/view/truth"].pose.position
            true.append((place.x, place.y, place.z))
    if true:
        stream.log("world/truth", rerun.LineStrips3D([true], colors=(40, 170, 40)), static=True)


_SHOWN: dict[str, Any] = {
    "keypoints": _show_keypoints,
    "segments": _show_segments,
    "planes": _show_planes,
    "manhattan": _show_axes,
    "pose": _show_pose,
    "map": _show_map,
    "surface": _show_surface,
}
FORMATS = (Format("rerun", "run.rrd", write_rerun),)
