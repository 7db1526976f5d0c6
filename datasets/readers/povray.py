"""The ICL-NUIM layout as POV-Ray wrote it: for each image a colour PNG, a text file of distances and a text file of the camera.

Distances are centimetres along the ray, positions centimetres, the camera's y axis points up.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trihedron.datasets.readers.association import Stamps
from trihedron.datasets.readers.images import MAX_BYTES
from trihedron.datasets.readers.matrices import MAX_DIGITS
from trihedron.datasets.readers.picture_headers import UnreadableImage
from trihedron.datasets.readers.sequence import DepthReader
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import read_file, read_text
from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.linalg import norm
from trihedron.pipeline.core.types import F32, F64, Camera, Trajectory

DEPTH_FILES = "scene_*_*.depth"
PER_METRE = 100.0
NOTHING_HIT = 1e5  # centimetres: further than any room
SECOND_NS = 1_000_000_000
MAX_CAMERA_BYTES = 1 << 16


@dataclass(frozen=True)
class Scene:
    """Image numbers (as that many seconds, in ns), their files, and the poses (y up, metres) of the images that have a camera file."""

    numbers: Stamps
    color_files: list[Path]
    depth_files: list[Path]
    truth: Trajectory | None


def read_scene(folder: Path) -> Scene:
    """List the folder's images in order of their number. Raises DataError when a number occurs twice or a camera file is wrong."""
    depths = {_number(file): file for file in folder.glob(DEPTH_FILES) if file.with_suffix(".png").is_file()}
    numbers = sorted(depths)
    if not numbers:
        raise DataError(str(folder), "holds .depth files but none of their .png images", "unpack the colour images into the same folder")
    files = [depths[number] for number in numbers]
    posed = [(number, file.with_suffix(".txt")) for number, file in zip(numbers, files) if file.with_suffix(".txt").is_file()]
    truth = None
    if posed:
        truth = Trajectory(_as_ns([number for number, _ in posed]), np.array([read_camera_pose(file) for _, file in posed]))
    return Scene(_as_ns(numbers), [file.with_suffix(".png") for file in files], files, truth)


def _as_ns(numbers: list[int]) -> Stamps:
    return np.array(numbers, dtype=np.int64) * SECOND_NS


def _number(file: Path) -> int:
    """scene_00_0042.depth -> 42."""
    digits = file.stem.rsplit("_", 1)[1]
    if not (digits.isdecimal() and len(digits) <= MAX_DIGITS):
        raise DataError(str(file), "has no image number in its name", "call it scene_00_0000.depth")
    return int(digits)


def read_camera_pose(path: Path) -> F64:
    """`cam_pos`, `cam_dir`, `cam_up` of a camera file -> (4, 4) `T_world_camera`, y up, metres. Raises DataError."""
    text = read_text(path, MAX_CAMERA_BYTES)
    position, forward, up = (_vector(path, text, key) for key in ("cam_pos", "cam_dir", "cam_up"))
    right = np.cross(up, forward)
    if norm(right) < 1e-9:
        raise DataError(str(path), "cam_dir and cam_up span no plane", "correct or remove the file")
    right /= norm(right)
    forward = forward / norm(forward)
    return pose_matrix(np.stack([right, np.cross(forward, right), forward], axis=-1), position / PER_METRE)


def _vector(path: Path, text: str, key: str) -> F64:
    match = re.search(rf"^[ \t]*{key}[ \t]*=[ \t]*\[([^\]]*)\]", text, flags=re.MULTILINE)
    try:
        vector = np.array([float(word) for word in match[1].replace(",", " ").split()]) if match else np.empty(0)
    except ValueError:
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise DataError(str(path), f"has no line '{key} = [x, y, z]'", "correct or remove the file")
    return vector


def depth_reader(camera: Camera) -> DepthReader:
    """A function that reads a .depth file as (h, w) metres along the optical axis, 0 = none. It raises UnreadableImage for a damaged file."""
    y, x = np.mgrid[: camera.height, : camera.width]
    stretch = np.sqrt(1.0 + ((x - camera.cx) / camera.fx) ** 2 + ((y - camera.cy) / camera.fy) ** 2)

    def read(path: Path) -> F32:
        try:
            distances = np.array(read_file(path, MAX_BYTES).decode("ascii").split(), dtype=np.float64)
        except OSError as error:
            raise UnreadableImage(f"cannot be opened ({error.strerror})") from error
        except ValueError as error:
            raise UnreadableImage("is not a list of numbers") from error
        if distances.size != stretch.size:
            raise UnreadableImage(f"holds {distances.size} distances instead of {stretch.size}")
        known = (distances > 0.0) & (distances < NOTHING_HIT)
        return np.asarray((np.where(known, distances, 0.0).reshape(stretch.shape) / (PER_METRE * stretch)).astype(np.float32))

    return read
