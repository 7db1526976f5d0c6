"""Recordings of the app Stray Scanner."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trihedron.datasets.readers.association import count_unpaired
from trihedron.datasets.readers.cameras import Calibration
from trihedron.datasets.readers.images import read_depth, read_levels
from trihedron.datasets.readers.matrices import files_by_number
from trihedron.datasets.readers.phones import ColorIntrinsics, Confidence, reduce, trusted
from trihedron.datasets.readers.sequence import ImageSequence, SequenceReader, first_size
from trihedron.datasets.readers.video import Video
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, U8, Camera, Trajectory
from trihedron.pipeline.record.trajectories import parse_trajectory, table_lines

DEPTH_SCALE = 1000.0
LAYOUT = "give a folder of Stray Scanner: rgb.mp4, depth/000000.png, confidence/, camera_matrix.csv and odometry.csv"
COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")


@register("dataset", "stray_scanner")
@dataclass(frozen=True)
class StrayScanner(SequenceReader):
    """Folder of the app Stray Scanner on an iPhone or iPad with LiDAR: rgb.mp4, depth/000000.png (mm), confidence/000000.png, odometry.csv and
    camera_matrix.csv. Colour is reduced to the depth image (256 × 192), whose view it shares. The phone's own poses (ARKit) stand for the
    truth, which they are roughly. The film is decoded in order: `frames=1000:` decodes what is before, too."""

    confidence: Confidence = 1  # least of a depth reading: 0 low, 1 medium, 2 high

    def _open(self, folder: Path) -> ImageSequence:
        numbers, poses = _odometry(folder / "odometry.csv")
        depths = files_by_number(folder / "depth", r"(\d+)\.png")
        rows = [row for row, number in enumerate(numbers) if number in depths]
        if not rows:
            raise DataError(str(folder), "holds no frames of Stray Scanner", LAYOUT)
        count_unpaired(folder, len(numbers), len(rows))
        film, stamps = Video(folder / "rgb.mp4"), poses.stamps_ns[rows]
        height, width = first_size([depths[numbers[row]] for row in rows], DEPTH_SCALE)
        fps = 1e9 / float(np.median(np.diff(poses.stamps_ns))) if len(numbers) > 1 else Camera.fps
        matrix = folder / "camera_matrix.csv"
        camera = ColorIntrinsics(film.width, film.height, *_intrinsics(matrix)).reduced(width, height, fps, str(matrix))

        def color(path: Path) -> U8:
            return reduce(film.frame(int(path.name)), camera)

        def depth(path: Path) -> F32:
            depth_m, levels = read_depth(path, DEPTH_SCALE), folder / "confidence" / path.name
            return trusted(depth_m, read_levels(levels), self.confidence, levels) if self.confidence else depth_m

        images = [folder / "rgb.mp4" / str(numbers[row]) for row in rows], [depths[numbers[row]] for row in rows]
        return ImageSequence(stamps, *images, Calibration(camera, DEPTH_SCALE), poses, depth_reader=depth, color_reader=color)


def _odometry(path: Path) -> tuple[list[int], Trajectory]:
    """Numbers of the frames, and their poses at increasing stamps. Newer versions of the app append columns."""
    rows = table_lines(path) if path.is_file() else []
    if not rows or tuple(rows[0][1][: len(COLUMNS)]) != COLUMNS:
        raise DataError(str(path), "is missing or has other columns", f"its first line must begin with '{', '.join(COLUMNS)}'")
    numbers = []
    for line, words in rows[1:]:
        if len(words) < len(COLUMNS) or not (words[1].isdecimal() and len(words[1]) <= 9):
            raise DataError(f"{path}:{line}", "is no line of odometry", f"each line holds '{', '.join(COLUMNS)}'; correct or remove this one")
        numbers.append(int(words[1]))
    return numbers, parse_trajectory([(line, [words[0], *words[2 : len(COLUMNS)]]) for line, words in rows[1:]], str(path))


def _intrinsics(path: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a file of 3 × 3 numbers."""
    words = [word for _, row in table_lines(path) for word in row] if path.is_file() else []
    try:
        K = np.array([float(word) for word in words]).reshape(3, 3)
    except ValueError as error:
        raise DataError(str(path), "is not a matrix of 3 × 3 numbers", LAYOUT) from error
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
