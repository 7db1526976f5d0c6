"""Trajectories of other programs, judged like our own runs: same frames, same association, same alignment, same share tracked."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError, RecordingError, UsageError
from trihedron.pipeline.core.types import FrameReference, Trajectory
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import MAX_DISTANCE_M, attached_truth, parse_trajectory, table_lines
from trihedron.pipeline.run.metrics import I64, associate, evaluate_trajectory

KITTI_COLUMNS = 12
ROUNDING_NS = 100_000  # stamps of other programs have 4 to 6 decimals
MOST_FOREIGN = 0.2  # of the poses may belong to frames that a run does not have; beyond that it is another sequence
MIRRORED = 0.5  # of the rotation error: a trajectory that fits that much better mirrored has another handedness


@dataclass(frozen=True)
class Reference:
    """Frames and ground truth of a run: what a trajectory is judged by. `overrides` are those of the run's data set."""

    recording: Path
    overrides: dict[str, str]
    stamps_ns: I64
    truth: Trajectory
    fps: float


def label_of(file: Path, labels: Sequence[str], number: int, count: int) -> str:
    """Return the label of file `number` of `count`: its own, the one for all, else its name. Raises UsageError."""
    if labels and len(labels) not in (1, count):
        raise UsageError("--label", f"there are {len(labels)} for {count} trajectories", "give one for all, or one for each in their order")
    return labels[number if len(labels) == count else 0] if labels else file.stem


def references(folders: Sequence[tuple[Path, dict[str, str]]]) -> list[Reference]:
    """Return the data of runs (folder, overrides), one for each data set: those that have a recording with frames and ground truth."""
    found: dict[tuple[tuple[str, str], ...], Reference] = {}
    for folder, overrides in folders:
        of_data = {key: value for key, value in overrides.items() if key.partition(".")[0] == "dataset"}
        key = tuple(sorted(of_data.items()))
        if key not in found and (reference := _reference(folder / RECORDING, of_data)) is not None:
            found[key] = reference
    return list(found.values())


@cache
def _frames(recording: Path) -> tuple[I64, float]:
    values = [value for value in Recording(recording).values("frames") if isinstance(value, FrameReference)]
    return np.array([value.stamp_ns for value in values], np.int64), values[0].camera.fps if values else 0.0


def _reference(recording: Path, overrides: dict[str, str]) -> Reference | None:
    try:
        opened = Recording(recording)
        truth = attached_truth(opened.attachments, str(recording))
        stamps, fps = _frames(recording) if "frames" in opened.topics else (np.zeros(0, np.int64), 0.0)
    except (DataError, RecordingError):
        return None
    return Reference(recording, overrides, stamps, truth, fps) if truth is not None and len(stamps) else None


def judge(file: Path, candidates: Sequence[Reference], y_up: bool = False) -> tuple[Reference, dict[str, Any]]:
    """Evaluate a trajectory, TUM or KITTI format, on the run's data that it belongs to; returns these and the figures of
    `pipeline.run.metrics.Metrics`. Raises DataError: unreadable, or of none or several of them."""
    if not candidates:
        raise DataError(str(file), "cannot be judged: none of the runs has a recording with ground truth", "give a run of the same sequence")
    rows = table_lines(file)
    kitti = bool(rows) and all(len(words) == KITTI_COLUMNS for _, words in rows)
    fitting = [found for reference in candidates if (found := _on_frames(file, rows, kitti, reference)) is not None]
    if len(fitting) != 1:
        what = f"{len(rows)} poses without stamps" if kitti else "its stamps"
        counts = ", ".join(f"{len(reference.stamps_ns)} in {reference.recording.parent}" for reference in candidates[:4])
        cause = f"{what} fit {len(fitting)} of {len(candidates)} data sets (frames: {counts})"
        raise DataError(str(file), cause, "give the runs of its sequence alone" if fitting else "give a run of the same frames, and TUM format")
    reference, estimate, foreign = fitting[0]
    if foreign:
        print(f"trihedron: warning: {file}: {foreign} poses of frames that {reference.recording} does not have are skipped", file=sys.stderr)
    return reference, _evaluate(file, estimate, reference, y_up)


def _evaluate(file: Path, estimate: Trajectory, reference: Reference, y_up: bool) -> dict[str, Any]:
    from trihedron.datasets.readers.icl_nuim import reflect

    mirrored = Trajectory(estimate.stamps_ns, reflect(estimate.poses))
    places = (str(file), str(reference.recording))
    straight, other = (
        evaluate_trajectory(trajectory, reference.truth, reference.fps, reference.stamps_ns, names=places) for trajectory in (estimate, mirrored)
    )
    if y_up:
        straight, other = other, straight
    if straight.rpe_frame_rmse_deg and other.rpe_frame_rmse_deg is not None and other.rpe_frame_rmse_deg < MIRRORED * straight.rpe_frame_rmse_deg:
        fits = f"its turns fit better mirrored ({other.rpe_frame_rmse_deg:.3f}° instead of {straight.rpe_frame_rmse_deg:.3f}° between frames)"
        print(f"trihedron: warning: {file}: {fits}; {'leave out' if y_up else 'give'} --y-up", file=sys.stderr)
    return straight.to_dict()


def _on_frames(file: Path, rows: list[tuple[int, list[str]]], kitti: bool, reference: Reference) -> tuple[Reference, Trajectory, int] | None:
    """Return the trajectory with the stamps of a run's frames, and how many of its poses have none; None where it is not of these frames."""
    stamps = reference.stamps_ns
    if kitti:
        return (reference, Trajectory(stamps, _kitti_poses(file, rows)), 0) if len(rows) == len(stamps) else None
    estimate = parse_trajectory(rows, str(file))
    pairs = associate(estimate.stamps_ns, stamps, ROUNDING_NS)
    foreign = len(estimate) - len(pairs)
    if foreign > MOST_FOREIGN * len(estimate):
        return None
    return reference, Trajectory(stamps[pairs[:, 1]], estimate.poses[pairs[:, 0]]), foreign


def _kitti_poses(file: Path, rows: list[tuple[int, list[str]]]) -> Any:
    """Return (n, 4, 4) poses of lines of 12 numbers, the upper rows of `T_world_camera`."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    for pose, (number, words) in zip(poses, rows):
        try:
            pose[:3] = np.array([float(word) for word in words]).reshape(3, 4)
        except ValueError:
            raise DataError(f"{file}:{number}", "a column is not a number", "each line holds the 12 numbers of a pose") from None
        if np.isfinite(pose).all() and np.abs(pose).max() > MAX_DISTANCE_M:
            raise DataError(f"{file}:{number}", f"a number is beyond {MAX_DISTANCE_M:g}", "each line holds the 12 numbers of a pose, metres")
    return poses
