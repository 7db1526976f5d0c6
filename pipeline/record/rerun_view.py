"""Values as entities of rerun, and the blueprint of their viewer. Needs rerun-sdk, which is imported when something is shown."""

from __future__ import annotations

from typing import Any

import numpy as np

from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.core.registry import drawing_of
from trihedron.pipeline.core.types import OK, Building, Camera, Frame, Keypoints, ManhattanFrame, Map, Planes, Pose, Segments, Surface, Value
from trihedron.pipeline.record.foxglove_messages import AXES, COLORS

CAMERA, IMAGE = "world/camera", "world/camera/image"
TIMES = "times"


def require_rerun() -> Any:
    """Import rerun. Raises LibraryError when it is not installed."""
    with imports_of("rerun"):
        import rerun
    return rerun


def blueprint() -> Any:
    """Return the layout of the viewer: the scene in 3D, the image, status and times."""
    import rerun.blueprint as rrb

    side = rrb.Vertical(
        rrb.Spatial2DView(origin=IMAGE, contents=["$origin/**", f"{CAMERA}/**"], name="image"),
        rrb.TextLogView(origin="status", name="status"),
        rrb.TimeSeriesView(origin=TIMES, name="stage times (ms)"),
        row_shares=[3, 1, 2],
    )
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="world", name="map"), side, column_shares=[2, 1]), collapse_panels=True)


def begin(stream: Any) -> None:
    """Log the axes of the world: those of the first camera."""
    import rerun

    stream.log("world", rerun.ViewCoordinates.RDF, static=True)


def at(stream: Any, index: int, stamp_ns: int) -> None:
    """Set the time of what is logged next, on both timelines."""
    stream.set_time("frame", sequence=index)
    stream.set_time("stamp", duration=1e-9 * stamp_ns)


def show_value(stream: Any, value: Value) -> None:
    """Log a value of a type that is shown; nothing for others."""
    for kind, show in _SHOWN.items():
        if isinstance(value, kind):
            show(stream, value)


def show_times(stream: Any, calls_ms: Any) -> None:
    """Log the time of each stage, in milliseconds."""
    import rerun

    for name, ms in calls_ms.items():
        stream.log(f"{TIMES}/{name}", rerun.Scalars(ms))


def show_pinhole(stream: Any, camera: Camera, scale: float) -> None:
    """Log the camera of images of a fraction of its size."""
    import rerun

    K = camera.K.copy()
    K[:2, 2] = (K[:2, 2] + 0.5) * scale  # rerun's pixels begin at their corner
    K[[0, 1], [0, 1]] *= scale
    size = [round(camera.width * scale), round(camera.height * scale)]
    stream.log(IMAGE, rerun.Pinhole(image_from_camera=K, resolution=size, camera_xyz=rerun.ViewCoordinates.RDF))


def _show_frame(stream: Any, value: Frame) -> None:
    import rerun

    show_pinhole(stream, value.camera, 1.0)
    stream.log(IMAGE, rerun.Image(value.color).compress(jpeg_quality=85))
    stream.log(f"{CAMERA}/depth", rerun.DepthImage(value.depth_m, meter=1.0))


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
    stream.log("status", rerun.TextLog(f"{value.status} {value.reason}", level="INFO" if value.status == OK else "WARN"))


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


def _show_drawing(stream: Any, value: Building) -> None:
    """Log what its slot draws of a value: solids, and outlines with their labels."""
    import rerun

    stream.log("world/building", rerun.Clear(recursive=True))
    drawing = drawing_of(value)
    for solid in drawing.solids:
        color = np.tile(np.array(solid.rgba, np.uint8), (len(solid.vertices_m), 1))
        mesh = rerun.Mesh3D(vertex_positions=solid.vertices_m, triangle_indices=solid.triangles, vertex_colors=color)
        stream.log(f"world/building/{solid.name}", mesh)
    for outline in drawing.outlines:
        lines = rerun.LineStrips3D([outline.corners_m], labels=[outline.label], colors=(40, 40, 40))
        stream.log(f"world/building/{outline.name}", lines)


_SHOWN: dict[type[Value], Any] = {
    Frame: _show_frame,
    Keypoints: _show_keypoints,
    Segments: _show_segments,
    Planes: _show_planes,
    ManhattanFrame: _show_axes,
    Pose: _show_pose,
    Map: _show_map,
    Surface: _show_surface,
    Building: _show_drawing,
}
