"""Poses and intrinsics as text files of 4 × 4 matrices, and folders of numbered images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from trihedron.datasets.readers.association import Stamps
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import nearest_rotation, pose_matrix
from trihedron.pipeline.core.linalg import det, matmul
from trihedron.pipeline.core.types import F64, Trajectory
from trihedron.pipeline.record.trajectories import MAX_STAMP_S, table_lines

MAX_DIGITS = 9  # of a frame's number
FARTHEST_M = 1e6
SKEWEST = 0.05  # largest entry of R'R - 1 of what is still a rotation, written with few digits


def read_matrix(path: Path) -> F64:
    """The (4, 4) matrix of a file of 16 numbers, finite or not. Raises DataError for anything else."""
    return matrix([word for _, words in table_lines(path) for word in words], str(path))


def matrix(words: list[str], place: str) -> F64:
    """16 words, row by row -> (4, 4). Raises DataError for another number of them, or for what is no number."""
    try:
        return np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError as error:
        raise DataError(place, "is not a matrix of 4 × 4 numbers", "give four numbers in each of four rows") from error


def trajectory_of(stamps_ns: Stamps, poses: Sequence[F64], places: Sequence[str]) -> Trajectory | None:
    """Poses (n times 4 × 4, `T_world_camera`) at increasing stamps; one that is not finite is left out, as of a tracker that was lost. None where
    nothing is left. Raises DataError, naming the place, for a matrix that is no pose."""
    known = [row for row, pose in enumerate(poses) if np.isfinite(pose).all()]
    found = []
    for row in known:
        R, t = poses[row][:3, :3], poses[row][:3, 3]
        if np.abs(poses[row][:3]).max() > FARTHEST_M or not np.abs(matmul(R.T, R) - np.eye(3)).max() < SKEWEST or det(R) < 0:
            raise DataError(places[row], "is not the pose of a camera", "correct or remove it")
        found.append(pose_matrix(nearest_rotation(R), t))
    return Trajectory(stamps_ns[known], np.array(found)) if found else None


def pose_files(stamps_ns: Stamps, files: Sequence[Path]) -> Trajectory | None:
    """`trajectory_of` the matrices in files, one a stamp; a stamp whose file is missing has no pose."""
    rows = [row for row, file in enumerate(files) if file.is_file()]
    return trajectory_of(stamps_ns[rows], [read_matrix(files[row]) for row in rows], [str(files[row]) for row in rows])


def files_by_number(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of a folder whose whole name fits a pattern with the number as its first group, in order of their numbers."""
    found = {}
    if folder.is_dir():
        for file in sorted(folder.iterdir()):  # of a JPEG and a PNG of one number the PNG
            match = re.fullmatch(pattern, file.name)
            if match and len(match[1]) <= MAX_DIGITS:
                found[int(match[1])] = file
    return dict(sorted(found.items()))


def frame_stamps(numbers: Sequence[int], fps: float) -> Stamps:
    """Stamps in ns of frames by their numbers. Raises DataError where they do not fit into 64 bits."""
    seconds = np.array(numbers, np.float64) / fps
    if not (seconds < MAX_STAMP_S).all():
        raise DataError("camera.yaml", f"fps is {fps:g}, too few for frame numbers up to {max(numbers)}", "give the frames per second")
    return np.rint(np.array(numbers, np.float64) * (1e9 / fps)).astype(np.int64)
