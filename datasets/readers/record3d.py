"""Recordings of the app Record3D."""

from __future__ import annotations

import json
import threading
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from imagecodecs import lzfse_decode

from trihedron.datasets.readers.association import Stamps
from trihedron.datasets.readers.cameras import Calibration
from trihedron.datasets.readers.images import MAX_BYTES, color_of
from trihedron.datasets.readers.matrices import MAX_DIGITS, frame_stamps, trajectory_of
from trihedron.datasets.readers.phones import ColorIntrinsics, Confidence, reduce, trusted
from trihedron.datasets.readers.picture_headers import UnreadableImage
from trihedron.datasets.readers.sequence import ImageSequence, SequenceReader
from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.core.files import SHOWN, open_file
from trihedron.pipeline.core.geometry import pose_matrix, rotation_from_quaternion
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, F64, U8, Trajectory
from trihedron.pipeline.record.trajectories import MAX_STAMP_S

METADATA = "metadata"
CURE = "export the recording as .r3d once more"
LIDAR = (192, 256)  # width and height of depth in files that state none
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # ARKit's camera looks along -z, with y up


@register("dataset", "record3d")
@dataclass(frozen=True)
class Record3D(SequenceReader):
    """A file .r3d of the app Record3D on an iPhone or iPad with LiDAR: a ZIP archive of metadata, rgbd/0.jpg, rgbd/0.depth (metres, LZFSE) and
    rgbd/0.conf. Colour is reduced to the depth image (192 × 256), whose view it shares. The phone's own poses (ARKit) stand for the
    truth, which they are roughly."""

    confidence: Confidence = 1  # least of a depth reading: 0 low, 1 medium, 2 high; nothing in recordings without

    def _place(self) -> Path:
        file = Path(self.path).expanduser()
        if not self.path or not file.is_file():
            raise DataError(self.path or "dataset.path", "is not a file", "give the .r3d file of Record3D as dataset.path")
        return file

    def _open(self, folder: Path) -> ImageSequence:
        archive = _Archive(folder)
        place, about = f"{folder}/{METADATA}", archive.metadata()
        numbers = sorted(int(name[5:-4]) for name in archive.names if _is_color(name) and f"{name[:-4]}.depth" in archive.names)
        if not numbers:
            raise DataError(str(folder), "holds no frames of Record3D", CURE)
        try:
            width, height = (int(about.get(key, default)) for key, default in zip(("dw", "dh"), LIDAR))
            K, fps = [float(x) for x in about["K"]], float(about.get("fps", 30.0))
            intrinsics = ColorIntrinsics(float(about["w"]), float(about["h"]), K[0], K[4], K[6], K[7])  # column by column
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise DataError(place, "does not describe a camera", CURE) from error
        camera = intrinsics.reduced(width, height, fps, place)

        def color(path: Path) -> U8:
            return reduce(color_of(archive.read(path), str(path)), camera)

        def depth(path: Path) -> F32:
            depth_m = np.frombuffer(archive.unpacked(path, 4 * width * height), "<f4").reshape(height, width)
            depth_m = np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(0.0))
            levels = path.with_suffix(".conf")
            if not self.confidence or f"rgbd/{levels.name}" not in archive.names:
                return depth_m
            return trusted(depth_m, np.frombuffer(archive.unpacked(levels, width * height), np.uint8).reshape(height, width), self.confidence, levels)

        stamps = _stamps(about, numbers, fps)
        images = [folder / "rgbd" / f"{n}.jpg" for n in numbers], [folder / "rgbd" / f"{n}.depth" for n in numbers]
        return ImageSequence(stamps, *images, Calibration(camera, 1.0), _poses(about, numbers, stamps, place), depth_reader=depth, color_reader=color)


class _Archive:
    """The ZIP archive, of one user at a time; its members are read within bounds."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, threading.Lock()
        try:
            self._zip = zipfile.ZipFile(open_file(path))
            self.names = frozenset(self._zip.namelist())
        except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError, RuntimeError) as error:
            raise DataError(str(path), f"is not a file of Record3D ({printable(str(error), SHOWN)})", CURE) from error

    def read(self, path: Path) -> bytes:
        """Return the bytes of a member by its path behind that of the archive. Raises UnreadableImage."""
        name = path.relative_to(self._path).as_posix()
        try:
            with self._lock, self._zip.open(name) as member:
                data = member.read(MAX_BYTES + 1)
        except Exception as error:  # zlib's, zipfile's and those of files
            raise UnreadableImage(f"is damaged ({printable(str(error), SHOWN)})") from error
        if len(data) > MAX_BYTES:
            raise UnreadableImage(f"has more than {MAX_BYTES} bytes")
        return data

    def unpacked(self, path: Path, size: int) -> bytes:
        """Return a member packed by LZFSE, of `size` bytes. Raises UnreadableImage."""
        try:
            data = bytes(lzfse_decode(self.read(path), out=size + 1))
        except RuntimeError as error:
            raise UnreadableImage(f"is damaged ({printable(str(error), SHOWN)})") from error
        if len(data) != size:
            raise UnreadableImage(f"does not hold {size} bytes")
        return data

    def metadata(self) -> dict[str, Any]:
        """Return the description of the recording. Raises DataError."""
        try:
            found = json.loads(self.read(self._path / METADATA))
        except (UnreadableImage, ValueError, RecursionError) as error:
            raise DataError(f"{self._path}/{METADATA}", "cannot be read", CURE) from error
        if not isinstance(found, dict):
            raise DataError(f"{self._path}/{METADATA}", "cannot be read", CURE)
        return found


def _is_color(name: str) -> bool:
    number = name.removeprefix("rgbd/").removesuffix(".jpg")
    return name == f"rgbd/{number}.jpg" and number.isdecimal() and len(number) <= MAX_DIGITS


def _rows(about: dict[str, Any], key: str, count: int, columns: int) -> F64 | None:
    """(count, columns) numbers of the metadata; None where they are not there, or others."""
    try:
        rows = np.array(about[key], np.float64).reshape(-1, columns)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    return rows if len(rows) >= count else None


def _stamps(about: dict[str, Any], numbers: list[int], fps: float) -> Stamps:
    """Stamps in ns as the recording states them, else by the rate."""
    seconds = _rows(about, "frameTimestamps", numbers[-1] + 1, 1)
    if seconds is not None and np.isfinite(seconds).all() and (np.abs(seconds) < MAX_STAMP_S).all():
        stamps = np.rint(seconds[numbers, 0] * 1e9).astype(np.int64)
        if (np.diff(stamps) > 0).all():
            return stamps
    return frame_stamps(numbers, fps)


def _poses(about: dict[str, Any], numbers: list[int], stamps: Stamps, place: str) -> Trajectory | None:
    """Poses `qx qy qz qw x y z` of the frames as `T_world_camera`, with y down; None where the recording has none."""
    rows = _rows(about, "poses", numbers[-1] + 1, 7)
    if rows is None or not ((rows[:, :4] ** 2).sum(axis=1) > 0.25).all():
        return None
    poses = [matmul(pose_matrix(rotation_from_quaternion(row[:4]), row[4:]), FLIP) for row in rows[numbers]]
    return trajectory_of(stamps, poses, [f"{place}: pose {n}" for n in numbers])
