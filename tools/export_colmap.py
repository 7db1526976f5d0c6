"""The map as a COLMAP model: keyframes with their images, the camera, and the points with their tracks. It can seed a Gaussian-splatting trainer.

The folder holds `images/` and `sparse/0/`, the model there both as text and binary, in the world of trajectory.txt. COLMAP puts the middle of the
first pixel at (0.5, 0.5), we at (0, 0)."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from trihedron.pipeline.app.recorded_values import frames_of, last_map, references_of
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import make_folder, write_file
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.core.types import I32, U8, FrameReference, Map
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.export import Format

HALF_PIXEL = 0.5
LEAST_VIEWS = 2  # of a point: COLMAP's tracks are no shorter


def write_colmap(recording: Recording, path: Path) -> str:
    """Write the folder. Raises DataError for a run without keyframes, or whose images are gone, LibraryError without pycolmap."""
    with imports_of("pycolmap"):
        import pycolmap

    map = last_map(recording)
    if map is None or not len(rows := _keyframes(map)):
        raise DataError(str(recording.path), "holds no keyframes", "record a run with a map")
    model, references, at = pycolmap.Reconstruction(), references_of(recording), frames_of(recording)
    folders = path / "images", path / "sparse" / "0"
    path.mkdir(parents=True, exist_ok=True)
    for folder in (folders[0], folders[1].parent, folders[1]):
        make_folder(folder)
    seen = _observations(map, rows)
    colors = np.full((len(map.points), 3), 128, np.uint8)
    first = references[int(map.keyframes.column("index")[rows[0]])].camera
    params = [first.fx, first.fy, first.cx + HALF_PIXEL, first.cy + HALF_PIXEL]
    model.add_camera_with_trivial_rig(pycolmap.Camera(model="PINHOLE", width=first.width, height=first.height, params=params, camera_id=1))
    for number, row in enumerate(rows, 1):
        index = int(map.keyframes.column("index")[row])
        name, mine = f"{index:06d}.png", seen[seen[:, 0] == row]
        pixels = map.point_observations.rows("pixel", mine[:, 2].astype(np.int32)).astype(np.float64)
        _save(folders[0] / name, at, references[index], colors, mine[:, 1], pixels)
        image = pycolmap.Image(name=name, keypoints=pixels + HALF_PIXEL, camera_id=1, image_id=number)
        pose = invert(map.keyframes.column("T_world_camera")[row])[:3]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    _add_points(model, map, rows, seen, colors)
    model.update_point_3d_errors()
    with tempfile.TemporaryDirectory() as written:
        model.write_binary(written)
        model.write_text(written)
        for file in Path(written).iterdir():
            write_file(folders[1] / file.name, file.read_bytes())
    return f"{model.num_images()} images, {model.num_points3D()} points with {model.compute_num_observations()} observations"


def _keyframes(map: Map) -> I32:
    """Rows (n,) of those that live in the world of the first."""
    return np.flatnonzero(map.keyframes.column("alive") & (map.keyframes.column("submap") == 0)).astype(np.int32)


def _observations(map: Map, keyframes: I32) -> Any:
    """(n, 3) keyframe, point, row of `point_observations`: of these keyframes and living points, each pair once, of points seen often enough."""
    keyframe, point = map.point_observations.column("keyframe"), map.point_observations.column("point")
    row = np.concatenate([np.empty(0, np.int64), *(np.arange(first, stop) for first, stop in map.keyframes.rows("points", keyframes))])
    row = row[map.points.column("alive")[point[row]]]
    _, once = np.unique(np.stack([keyframe[row], point[row]], axis=1), axis=0, return_index=True)
    row = row[np.sort(once)]
    views = np.bincount(point[row], minlength=len(map.points))
    row = row[views[point[row]] >= LEAST_VIEWS]
    return np.stack([keyframe[row], point[row], row], axis=1)


def _save(path: Path, at: Any, reference: FrameReference, colors: U8, points: Any, pixels: Any) -> None:
    frame = at(reference)
    if frame is None:
        raise DataError(str(path), f"frame {reference.index} cannot be read", "record with record.frames=true")
    write_file(path, bytes(cv2.imencode(".png", frame.color[..., ::-1])[1]))
    colors[points] = colors_at(frame.color, pixels)


def _add_points(model: Any, map: Map, keyframes: I32, seen: Any, colors: U8) -> None:
    import pycolmap

    image = {int(row): number for number, row in enumerate(keyframes, 1)}
    place = np.concatenate([np.arange(count) for count in np.unique(seen[:, 0], return_counts=True)[1]]) if len(seen) else np.empty(0, int)
    order = np.argsort(seen[:, 0], kind="stable")
    within = np.empty(len(seen), np.int64)
    within[order] = place
    positions = map.points.column("position_m")
    for point in np.unique(seen[:, 1]):
        track = pycolmap.Track()
        for o in np.flatnonzero(seen[:, 1] == point):
            track.add_element(image[int(seen[o, 0])], int(within[o]))
        model.add_point3D(positions[point], track, colors[point])


FORMATS = (Format("colmap", "colmap", write_colmap),)


def colors_at(image: Any, pixels: Any) -> Any:
    """(n, 3) RGB at pixels (n, 2), the nearest."""
    x, y = np.rint(pixels).astype(int).T
    return image[np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)]
