"""Errors of a reconstructed surface against the true one: accuracy, completeness, planar and curved parts."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trihedron.pipeline.core.errors import DataError

if TYPE_CHECKING:
    from trihedron.comparison.surface_truth import Truth
    from trihedron.pipeline.core.types import F64, I32, Trajectory

TRAJECTORY = "trajectory.txt"
SAMPLE_M = 0.02  # between the points of the mesh that are judged
WITHIN_M = (0.02, 0.05)
PARTS = ("all", "planar", "curved")
TRUTHS = 8  # kept for further runs of their data sets: rendering one takes ten times as long as judging a mesh by it


def evaluate_files(mesh: Path, recording: Path) -> dict[str, Any]:
    """Return `mesh_errors` of a mesh file in the world of the trajectory.txt beside it, or beside the recording. Raises DataError."""
    from trihedron.comparison.mesh_files import read_mesh

    vertices, triangles = read_mesh(mesh)
    T, truth = alignment_and_truth(trajectory_in(mesh.parent, recording.parent), recording)
    return {**mesh_errors(vertices @ T[:3, :3].T + T[:3, 3], triangles, truth), "bytes": mesh.stat().st_size}


def trajectory_in(*folders: Path) -> Path:
    """Return the trajectory.txt of the first folder that has one; that of the first where none has."""
    return next((folder / TRAJECTORY for folder in folders if (folder / TRAJECTORY).is_file()), folders[0] / TRAJECTORY)


def alignment_and_truth(trajectory: Path, recording: Path) -> tuple[F64, Truth]:
    """(4, 4) `T_truth_world` that aligns the trajectory with the recording's ground truth, and the true surface of its data set. Raises DataError."""
    from trihedron.pipeline.record.reader import Recording
    from trihedron.pipeline.record.trajectories import attached_truth

    opened = Recording(recording)
    expected = attached_truth(opened.attachments, str(recording))
    if expected is None:
        raise DataError(str(recording), "holds no ground truth, so the mesh cannot be aligned", "run on a data set with ground truth")
    return alignment(trajectory, expected), _truth(_dataset(opened), expected.stamps_ns.tobytes(), expected.poses.tobytes())


def alignment(trajectory: Path, truth: Trajectory) -> F64:
    """Return the (4, 4) `T_truth_world` that aligns a trajectory file with the truth. Raises DataError for fewer than three poses with a truth."""
    from trihedron.pipeline.core.geometry import umeyama
    from trihedron.pipeline.record.trajectories import read_trajectory
    from trihedron.pipeline.run.metrics import associate

    estimate = read_trajectory(trajectory)
    pairs = associate(estimate.stamps_ns, truth.stamps_ns)
    if len(pairs) < 3:
        raise DataError(str(trajectory), f"{len(pairs)} of its poses have a truth", "give the recording of the same run")
    return umeyama(estimate.poses[pairs[:, 0], :3, 3], truth.poses[pairs[:, 1], :3, 3])


@lru_cache(maxsize=TRUTHS)
def _truth(dataset: Any, stamps_ns: bytes, poses: bytes) -> Truth:
    """Return the truth of a data set; that of the last few is kept, for the runs of a sweep share it."""
    import numpy as np

    from trihedron.comparison.surface_truth import truth_of
    from trihedron.pipeline.core.types import Trajectory

    return truth_of(dataset, Trajectory(np.frombuffer(stamps_ns, np.int64), np.frombuffer(poses, np.float64).reshape(-1, 4, 4)))


def _dataset(recording: Any) -> Any:
    """The data set of a run, from the configuration in its recording."""
    from trihedron.pipeline.app.recorded_run import composed_run
    from trihedron.pipeline.core.config import make_plugin

    return make_plugin("dataset", composed_run(recording).dataset)


def mesh_errors(vertices: F64, triangles: I32, truth: Truth) -> dict[str, Any]:
    """The figures of a mesh in the world of the truth: triangles, and per part accuracy in metres (mean, RMSE, 95 %) and completeness within
    WITHIN_M. A point of the mesh belongs to the part that is nearest to it."""
    import numpy as np

    from trihedron.comparison.mesh_distance import NearestTriangle, sample_triangles

    points, _, area = sample_triangles(vertices, triangles, SAMPLE_M)
    off, bent = truth.distance(points)
    missed, _ = NearestTriangle(vertices, triangles).query(truth.seen_m)
    figures: dict[str, Any] = {"triangles": len(triangles), "area_m2": float(area.sum()), "parts": {}}
    for part in PARTS if truth.labelled else PARTS[:1]:
        mine = np.ones(len(off), np.bool_) if part == "all" else bent == (part == "curved")
        theirs = np.ones(len(missed), np.bool_) if part == "all" else truth.curved == (part == "curved")
        figures["parts"][part] = {
            **_accuracy(off[mine], area[mine]),
            **{f"within_{1e2 * limit:.0f}_cm": float(np.mean(missed[theirs] <= limit)) if theirs.any() else None for limit in WITHIN_M},
        }
    return figures


def _accuracy(off: F64, area: F64) -> dict[str, Any]:
    """Mean, RMSE and 95 % of distances, each weighed by its area; None without any."""
    import numpy as np

    if area.sum() <= 0.0:
        return dict.fromkeys(("mean_m", "rmse_m", "p95_m"))
    order = np.argsort(off)
    share = np.cumsum(area[order]) / area.sum()
    p95 = off[order][min(int(np.searchsorted(share, 0.95)), len(off) - 1)]
    return {"mean_m": float(np.average(off, weights=area)), "rmse_m": float(np.sqrt(np.average(off**2, weights=area))), "p95_m": float(p95)}
