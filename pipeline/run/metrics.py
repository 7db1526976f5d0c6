"""Errors of a trajectory against the truth: ATE, RPE and the share of frames tracked, as the benchmarks define them (Sturm et al., IROS 2012)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import invert, nearest_pairs, transform, umeyama
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, Trajectory

I64 = NDArray[np.int64]
MAX_DIFFERENCE_NS = 20_000_000  # between a pose and its truth; half a frame at 25 Hz, and the benchmark's usual value
GAP_STEPS = 2.5  # a longer step between poses is a gap of the trajectory, a shorter one may be a frame the sensor dropped (TUM: up to 2.2)
FEWEST_POSES = 3  # an alignment of fewer means nothing


@dataclass(frozen=True)
class Metrics:
    """Errors of a trajectory after SE(3) alignment. Lengths in metres, angles in degrees; None where no pair of poses is that far apart.

    `rpe_frame_*` compares poses 1 frame apart, `rpe_second_*` poses `rpe_second_frames` = round(fps) frames apart, over all such pairs.
    `tracked_share` is `poses_with_truth / frames_with_truth`. `share_basis` is the source of the frames: "frames" when the data set's stamps
    were given, else "ground truth": the frames the whole ground truth has at the trajectory's rate, so what was lost at either end counts
    too, and so does ground truth beyond the sequence. `tracked_share_in_span` looks only between the first and the last pose."""

    ate_rmse_m: float
    ate_mean_m: float
    ate_median_m: float
    ate_max_m: float
    rpe_frame_rmse_m: float | None
    rpe_frame_median_m: float | None
    rpe_frame_rmse_deg: float | None
    rpe_frame_median_deg: float | None
    rpe_frame_pairs: int
    rpe_second_frames: int
    rpe_second_rmse_m: float | None
    rpe_second_median_m: float | None
    rpe_second_rmse_deg: float | None
    rpe_second_median_deg: float | None
    rpe_second_pairs: int
    poses: int
    poses_with_truth: int
    frames_with_truth: int
    tracked_share: float
    tracked_share_in_span: float
    share_basis: str

    def to_dict(self) -> dict[str, Any]:
        """Return field name -> value, ready for JSON."""
        return asdict(self)


def associate(estimate_stamps_ns: I64, truth_stamps_ns: I64, max_difference_ns: int = MAX_DIFFERENCE_NS) -> I64:
    """Associate stamps: (n, 2) rows (estimate, truth) at most `max_difference_ns` apart: the nearest pair first, each stamp at most once
    (the rule of the TUM benchmark).

    Both inputs increase. Of two equally near truths the earlier one is taken. Rows are in the order of the estimate."""
    return nearest_pairs(estimate_stamps_ns, truth_stamps_ns, max_difference_ns)


def evaluate_trajectory(
    estimate: Trajectory,
    truth: Trajectory,
    fps: float | None = None,
    frame_stamps_ns: I64 | None = None,
    max_difference_ns: int = MAX_DIFFERENCE_NS,
    names: tuple[str, str] = ("trajectory", "ground truth"),
) -> Metrics:
    """Compare a trajectory with the truth. `fps` (default: by the stamps) is the number of frames in one second.

    `frame_stamps_ns` are the stamps of all frames of the data set, those of the estimate among them: they number the poses, and the share of
    tracked frames refers to them. Without them poses are numbered by their stamps (see `GAP_STEPS`) and the share is over the ground truth.
    Raises DataError, naming `names`, for poses that are not finite, stamps that do not increase, and fewer than 3 poses with truth."""
    for name, trajectory in zip(names, (estimate, truth)):
        _check(trajectory, name)
    pairs, numbers = _pairs_by_frame(estimate, truth, frame_stamps_ns, max_difference_ns)
    if len(pairs) < FEWEST_POSES:
        raise _too_few(estimate, truth, len(pairs), max_difference_ns, names)
    poses, true_poses = estimate.poses[pairs[:, 0]], truth.poses[pairs[:, 1]]
    errors = aligned_errors(poses, true_poses)
    second = max(1, round(fps if fps is not None else _fps(estimate.stamps_ns if frame_stamps_ns is None else frame_stamps_ns)))
    basis = estimate.stamps_ns[[0, -1]] + np.array([-max_difference_ns, max_difference_ns])
    frames, frames_in_span = (_frames_with_truth(span, estimate, truth, frame_stamps_ns, max_difference_ns) for span in (None, basis))
    return Metrics(
        ate_rmse_m=_rmse(errors),
        ate_mean_m=float(errors.mean()),
        ate_median_m=float(np.median(errors)),
        ate_max_m=float(errors.max()),
        **_relative("rpe_frame", poses, true_poses, numbers, 1),
        rpe_second_frames=second,
        **_relative("rpe_second", poses, true_poses, numbers, second),
        poses=len(estimate),
        poses_with_truth=len(pairs),
        frames_with_truth=max(frames, len(pairs)),
        tracked_share=len(pairs) / max(frames, len(pairs)),
        tracked_share_in_span=len(pairs) / max(frames_in_span, len(pairs)),
        share_basis="ground truth" if frame_stamps_ns is None else "frames",
    )


def frame_errors(estimate: Trajectory, truth: Trajectory, fps: float, frame_stamps_ns: I64) -> dict[str, F64]:
    """Return the (n,) errors of the n frames behind the root mean squares of `evaluate_trajectory`, by the names they have in `Metrics`.

    NaN where a frame has none. The error of a pair of poses (RPE) is that of its first frame. Empty for fewer than 3 poses with truth."""
    pairs, numbers = _pairs_by_frame(estimate, truth, frame_stamps_ns, MAX_DIFFERENCE_NS)
    if len(pairs) < FEWEST_POSES:
        return {}
    poses, true_poses = estimate.poses[pairs[:, 0]], truth.poses[pairs[:, 1]]
    found = {"ate_rmse_m": (numbers, aligned_errors(poses, true_poses))}
    for prefix, apart in (("rpe_frame", 1), ("rpe_second", max(1, round(fps)))):
        first, second = _rows_apart(numbers, apart)
        metres, degrees = relative_errors(poses, true_poses, first, second)
        found |= {f"{prefix}_rmse_m": (numbers[first], metres), f"{prefix}_rmse_deg": (numbers[first], degrees)}
    errors = {name: np.full(len(frame_stamps_ns), np.nan) for name in found}
    for name, (frames, values) in found.items():
        errors[name][frames] = values
    return errors


def aligned_errors(poses: F64, true_poses: F64) -> F64:
    """Return (n,) distances of the positions of two sets of (n, 4, 4) poses in metres, after the best SE(3) alignment."""
    positions, true_positions = poses[:, :3, 3], true_poses[:, :3, 3]
    return np.asarray(np.linalg.norm(true_positions - transform(umeyama(positions, true_positions), positions), axis=1))


def relative_errors(poses: F64, true_poses: F64, first: I64, second: I64) -> tuple[F64, F64]:
    """Return errors of the motion between poses `first` and `second` (rows): (n,) metres and (n,) degrees of `(Qi⁻¹ Qj)⁻¹ (Pi⁻¹ Pj)`."""
    motion = matmul(invert(poses[first]), poses[second])
    true_motion = matmul(invert(true_poses[first]), true_poses[second])
    error = matmul(invert(true_motion), motion)
    return np.linalg.norm(error[:, :3, 3], axis=1), rotation_angles_deg(error[:, :3, :3])


def rotation_angles_deg(R: F64) -> F64:
    """Return the (n,) angles of (n, 3, 3) rotations, by sine and cosine so that small ones are exact."""
    sine = 0.5 * np.linalg.norm(np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]]), axis=0)
    cosine = 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0)
    return np.asarray(np.degrees(np.arctan2(sine, cosine)))


def _relative(prefix: str, poses: F64, true_poses: F64, numbers: I64, apart: int) -> dict[str, Any]:
    """Return the RPE fields of Metrics over all pairs of poses whose frame numbers are `apart`."""
    first, second = _rows_apart(numbers, apart)
    found = len(first) > 0
    metres, degrees = relative_errors(poses, true_poses, first, second)
    return {
        f"{prefix}_rmse_m": _rmse(metres) if found else None,
        f"{prefix}_median_m": float(np.median(metres)) if found else None,
        f"{prefix}_rmse_deg": _rmse(degrees) if found else None,
        f"{prefix}_median_deg": float(np.median(degrees)) if found else None,
        f"{prefix}_pairs": len(first),
    }


def _rows_apart(numbers: I64, apart: int) -> tuple[I64, I64]:
    """Return the rows of all pairs of frame numbers that are `apart`: those of the first and of the second."""
    second = np.searchsorted(numbers, numbers + apart)
    first = np.flatnonzero(second < len(numbers))
    first = first[numbers[second[first]] == numbers[first] + apart]
    return first, second[first]


def _pairs_by_frame(estimate: Trajectory, truth: Trajectory, frame_stamps_ns: I64 | None, max_difference_ns: int) -> tuple[I64, I64]:
    """Return (n, 2) rows (estimate, truth), and the (n,) frame numbers of these poses."""
    if frame_stamps_ns is None:
        pairs = associate(estimate.stamps_ns, truth.stamps_ns, max_difference_ns)
        return pairs, _numbers_by_stamp(estimate.stamps_ns)[pairs[:, 0]]
    _, rows, numbers = np.intersect1d(estimate.stamps_ns, frame_stamps_ns, assume_unique=True, return_indices=True)
    frames = associate(frame_stamps_ns, truth.stamps_ns, max_difference_ns)
    _, tracked, frames_tracked = np.intersect1d(numbers, frames[:, 0], assume_unique=True, return_indices=True)
    return np.stack([rows[tracked], frames[frames_tracked, 1]], axis=1), numbers[tracked]


def _numbers_by_stamp(stamps_ns: I64) -> I64:
    """Number frames by the poses' stamps alone: 1 a pose, more over a gap."""
    if len(stamps_ns) < 2:
        return np.zeros(len(stamps_ns), np.int64)
    steps = np.diff(stamps_ns) / _period_ns(stamps_ns)
    return np.concatenate([[0], np.cumsum(np.where(steps > GAP_STEPS, np.round(steps), 1.0))]).astype(np.int64)


def _frames_with_truth(span: I64 | None, estimate: Trajectory, truth: Trajectory, frame_stamps_ns: I64 | None, max_difference_ns: int) -> int:
    """Count the frames with truth, all or those in a span of stamps; without the frames' stamps, those the truth has at the estimate's rate."""
    stamps = truth.stamps_ns if frame_stamps_ns is None else frame_stamps_ns
    if span is not None:
        stamps = stamps[(stamps >= span[0]) & (stamps <= span[1])]
    if frame_stamps_ns is not None:
        return len(associate(stamps, truth.stamps_ns, max_difference_ns))
    period = _period_ns(estimate.stamps_ns)
    if len(stamps) < 2 or _period_ns(stamps) > 0.75 * period:
        return len(stamps)
    return len(np.unique((stamps - stamps[0]) // period))


def _period_ns(stamps_ns: I64) -> float:
    return float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 1e9 / 30.0


def _fps(stamps_ns: I64) -> float:
    """Estimate the frames a second by the mean step, gaps apart: a real camera's steps scatter to one side, and their median is off by 3 % (TUM)."""
    steps = np.diff(stamps_ns)
    usual = steps[steps < 1.5 * _period_ns(stamps_ns)]
    return 1e9 / float(usual.mean()) if len(usual) else 30.0


def _rmse(errors: F64) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def _check(trajectory: Trajectory, name: str) -> None:
    bad = np.flatnonzero(~np.isfinite(trajectory.poses.reshape(-1, 16)).all(axis=1))
    if len(bad):
        cause = f"{len(bad)} of {len(trajectory)} poses are not finite, the first at {trajectory.stamps_ns[bad[0]] / 1e9:.6f} s"
        raise DataError(name, cause, "remove the frames that have no pose")
    backwards = np.flatnonzero(np.diff(trajectory.stamps_ns) <= 0)
    if len(backwards):
        raise DataError(name, f"the stamps do not increase at {trajectory.stamps_ns[backwards[0] + 1] / 1e9:.6f} s", "sort the poses, one a stamp")


def _too_few(estimate: Trajectory, truth: Trajectory, count: int, max_difference_ns: int, names: tuple[str, str]) -> DataError:
    """Return the error for a comparison of fewer than 3 poses: no overlap, or too little."""
    for name, trajectory in zip(names, (estimate, truth)):
        if len(trajectory) < FEWEST_POSES:
            return DataError(name, f"has {len(trajectory)} poses", f"an evaluation needs at least {FEWEST_POSES}")
    spans = [(t.stamps_ns[0] / 1e9, t.stamps_ns[-1] / 1e9) for t in (estimate, truth)]
    text = [f"{first:.3f} to {last:.3f} s" for first, last in spans]
    slack_s = max_difference_ns / 1e9
    if spans[0][0] > spans[1][1] + slack_s or spans[1][0] > spans[0][1] + slack_s:
        return DataError(names[0], f"no overlap in time with {names[1]}: {text[0]} against {text[1]}", "give files of the same clock")
    cause = f"{count} of {len(estimate)} poses have truth within {max_difference_ns / 1e6:g} ms in {names[1]}, {FEWEST_POSES} are needed"
    return DataError(names[0], cause, f"give files of the same clock ({text[0]} against {text[1]}) or allow a larger difference")
