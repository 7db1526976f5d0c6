"""The plot of a run: the trajectory from above, and its errors over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import new_file
from trihedron.pipeline.core.geometry import nearest_rotation, transform, umeyama
from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import DEGRADED, F64, LOST, Trajectory
from trihedron.pipeline.run.metrics import FEWEST_POSES, associate, rotation_angles_deg

AXES = "xyz"
MARGINS = {"left": 0.07, "right": 0.98, "bottom": 0.07, "top": 0.93, "wspace": 0.22, "hspace": 0.25}  # to compute them is to draw everything twice
ESTIMATE_COLOR, TRUTH_COLOR = "tab:blue", "tab:green"
STATUS_COLORS = {DEGRADED: "tab:orange", LOST: "tab:red"}
GAP_STEPS = 5.0  # a curve is broken where its stamps are that many median steps apart, instead of a straight line across


def trajectory_figure(estimate: Trajectory, truth: Trajectory | None, path: Path, status: Sequence[tuple[int, str]] = ()) -> None:
    """Write a PNG: the trajectory over its two widest axes, the position per axis or, with truth, the errors per axis and of the rotation.

    The estimate is aligned to the truth (SE(3)). `status` are (stamp_ns, ok | degraded | lost) of all frames; those that are not ok are marked.
    Truth that has fewer than 3 stamps in common is skipped. Raises DataError when the file cannot be written,
    LibraryError without matplotlib."""
    with imports_of("matplotlib"):
        from matplotlib.figure import Figure

    pairs = associate(estimate.stamps_ns, truth.stamps_ns) if truth is not None else np.empty((0, 2), np.int64)
    figure = Figure(figsize=(11, 8))
    if truth is not None and len(pairs) >= FEWEST_POSES:
        _with_truth(figure, estimate, truth, pairs, status)
    else:
        _without_truth(figure, estimate, status)
    try:
        with new_file(path) as new:
            figure.savefig(new, dpi=100)
    except OSError as error:
        raise DataError(str(path), f"cannot be written: {error.strerror}", "give another folder") from error


def _with_truth(figure: Any, estimate: Trajectory, truth: Trajectory, pairs: NDArray[np.int64], status: Sequence[tuple[int, str]]) -> None:
    """Draw both trajectories from above, and the errors of the aligned poses."""
    poses, true_poses = estimate.poses[pairs[:, 0]], truth.poses[pairs[:, 1]]
    alignment = umeyama(poses[:, :3, 3], true_poses[:, :3, 3])
    errors = transform(alignment, poses[:, :3, 3]) - true_poses[:, :3, 3]
    grid = figure.add_gridspec(4, 2, **MARGINS)
    span = slice(pairs[:, 1].min(), pairs[:, 1].max() + 1)
    true_path = Trajectory(truth.stamps_ns[span], truth.poses[span])
    path = Trajectory(estimate.stamps_ns, matmul(alignment, estimate.poses))
    _draw_top(figure.add_subplot(grid[:, 0]), path, true_path)
    stamps = estimate.stamps_ns[pairs[:, 0]]
    curves = [(f"{name} error (mm)", 1e3 * errors[:, i]) for i, name in enumerate(AXES)]
    curves.append(("rotation error (°)", _rotation_errors(poses, true_poses)))
    _draw_curves(figure, grid, stamps, curves, status)
    rmse = float(np.sqrt((errors**2).sum(axis=1).mean()))
    figure.suptitle(f"{len(estimate)} poses, {len(pairs)} with ground truth: ATE RMSE {rmse:.4f} m after SE(3) alignment")


def _rotation_errors(poses: F64, true_poses: F64) -> F64:
    """Return (n,) degrees between the poses and their truth after the rotation that best fits all rotations: an alignment by positions that lie
    nearly on a line leaves the rotation about that line open."""
    turn = nearest_rotation(np.einsum("nij,nkj->ik", true_poses[:, :3, :3], poses[:, :3, :3]))
    return rotation_angles_deg(matmul(np.swapaxes(true_poses[:, :3, :3], 1, 2), turn, poses[:, :3, :3]))


def _without_truth(figure: Any, estimate: Trajectory, status: Sequence[tuple[int, str]]) -> None:
    """Draw the trajectory from above, and the position over time."""
    grid = figure.add_gridspec(3, 2, **MARGINS)
    _draw_top(figure.add_subplot(grid[:, 0]), estimate, None)
    _draw_curves(figure, grid, estimate.stamps_ns, [(f"{name} (m)", estimate.poses[:, i, 3]) for i, name in enumerate(AXES)], status)
    figure.suptitle(f"{len(estimate)} poses, no ground truth")


def _draw_top(axes: Any, estimate: Trajectory, truth: Trajectory | None) -> None:
    """Draw trajectories over the two axes of their largest extent, in the world frame of the truth if there is one."""
    points = np.concatenate([t.poses[:, :3, 3] for t in (estimate, truth) if t is not None])
    across, up = sorted(np.argsort(-np.ptp(points, axis=0), kind="stable")[:2])
    for trajectory, color, label in ((truth, TRUTH_COLOR, "ground truth"), (estimate, ESTIMATE_COLOR, "estimate")):
        if trajectory is not None:
            broken = _break_at_gaps(trajectory.stamps_ns, trajectory.poses[:, :3, 3])
            axes.plot(broken[:, across], broken[:, up], color=color, label=label, linewidth=1.5 if color == ESTIMATE_COLOR else 3.0)
    start = estimate.poses[0, :3, 3]
    axes.plot(start[across], start[up], "o", color="black", markersize=5, label="start")
    axes.set(xlabel=f"{AXES[across]} (m)", ylabel=f"{AXES[up]} (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(loc="best")


def _draw_curves(figure: Any, grid: Any, stamps_ns: NDArray[np.int64], curves: list[tuple[str, F64]], status: Sequence[tuple[int, str]]) -> None:
    """Draw quantities one above the other over seconds since the first stamp, with a mark at the lower edge for each frame that is not ok."""
    axes = None
    for row, (label, values) in enumerate(curves):
        axes = figure.add_subplot(grid[row, 1], sharex=axes)
        curve = _break_at_gaps(stamps_ns, np.column_stack([(stamps_ns - stamps_ns[0]) / 1e9, values]))
        axes.plot(curve[:, 0], curve[:, 1], color=ESTIMATE_COLOR, linewidth=1.0)
        for name, color in STATUS_COLORS.items():
            times = [(stamp_ns - stamps_ns[0]) / 1e9 for stamp_ns, found in status if found == name]
            if times:
                axes.plot(times, np.zeros(len(times)), "|", color=color, label=name, transform=axes.get_xaxis_transform(), markersize=12)
                if row == 0:
                    axes.legend(loc="upper right")
        axes.set(ylabel=label, xlabel="time (s)" if row == len(curves) - 1 else "")
        axes.grid(alpha=0.3)


def _break_at_gaps(stamps_ns: NDArray[np.int64], rows: F64) -> F64:
    """Insert a NaN row into rows over time at each gap, so that the line breaks."""
    steps = np.diff(stamps_ns)
    gaps = np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1 if len(steps) else np.empty(0, np.int64)
    return np.insert(rows, gaps, np.nan, axis=0)
