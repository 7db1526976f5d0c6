"""Judge a mesh by the true surface: accuracy, completeness, triangles and bytes, planar and curved parts apart where the truth distinguishes them.

MESH is a run folder, whose surface.ply is judged, or a file (ply, obj) in the world of the trajectory beside it, or else beside TRUTH. TRUTH is the
run's recording, or its folder: the truth is that of its data set, the exact surface of the synthetic scenes, rendered depth for ICL-NUIM. By
default the mesh's own folder, which then keeps the figures as surface.json. The mesh is moved by the SE(3) that aligns trajectory.txt with the
ground truth, never by itself.

Accuracy is the distance from the mesh to the truth, over its area. Completeness is the share of the truth that was seen, where a sensor reading
fell, that is within 2 and 5 cm of the mesh; what cannot be seen counts for nothing.

Example: trihedron evaluate-surface runs/latest runs/latest/run.mcap
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trihedron.pipeline.core.errors import DataError
from trihedron.tools.arguments import Parser, table

if TYPE_CHECKING:
    from trihedron.pipeline.core.types import F64, I32, Trajectory
    from trihedron.tools.surface_truth import Truth

SURFACE, TRAJECTORY, RECORDING = "surface.ply", "trajectory.txt", "run.mcap"
FIGURES = "surface.json"  # what is found of a run by its own truth is kept beside it, for `trihedron compare`
SAMPLE_M = 0.02  # between the points of the mesh that are judged
WITHIN_M = (0.02, 0.05)
PARTS = ("all", "planar", "curved")
TRUTHS = 8  # kept for further runs of their data sets: rendering one takes ten times as long as judging a mesh by it


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises DataError for files that cannot be judged, UsageError for wrong arguments."""
    parser = Parser("evaluate-surface", __name__)
    parser.add_argument("mesh", metavar="MESH", type=Path, help="a run folder or a mesh file")
    parser.add_argument("truth", metavar="TRUTH", type=Path, nargs="?", help="the run's recording or folder (default: that of MESH)")
    parser.add_argument("--json", action="store_true", help="print every figure as JSON")
    arguments = parser.parse_args(argv)
    mesh: Path = arguments.mesh / SURFACE if arguments.mesh.is_dir() else arguments.mesh
    truth: Path = arguments.truth or mesh.parent
    figures = evaluate_files(mesh, truth / RECORDING if truth.is_dir() else truth)
    if arguments.mesh.is_dir() and arguments.truth is None:
        (arguments.mesh / FIGURES).write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures, indent=2) if arguments.json else report(figures))
    return 0


def evaluate_files(mesh: Path, recording: Path) -> dict[str, Any]:
    """The figures of `judged` for a mesh file in the world of the trajectory.txt beside it, or beside the recording. Raises DataError."""
    from trihedron.tools.mesh_files import read_mesh

    vertices, triangles = read_mesh(mesh)
    T, truth = prepared(trajectory_in(mesh.parent, recording.parent), recording)
    return {**judged(vertices @ T[:3, :3].T + T[:3, 3], triangles, truth), "bytes": mesh.stat().st_size}


def trajectory_in(*folders: Path) -> Path:
    """Return the trajectory.txt of the first folder that has one; that of the first where none has."""
    return next((folder / TRAJECTORY for folder in folders if (folder / TRAJECTORY).is_file()), folders[0] / TRAJECTORY)


def prepared(trajectory: Path, recording: Path) -> tuple[F64, Truth]:
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

    from trihedron.pipeline.core.types import Trajectory
    from trihedron.tools.surface_truth import truth_of

    return truth_of(dataset, Trajectory(np.frombuffer(stamps_ns, np.int64), np.frombuffer(poses, np.float64).reshape(-1, 4, 4)))


def _dataset(recording: Any) -> Any:
    """The data set of a run, from the configuration in its recording."""
    from trihedron.pipeline.app.recorded_run import composed_run
    from trihedron.pipeline.core.config import make_plugin

    return make_plugin("dataset", composed_run(recording).dataset)


def judged(vertices: F64, triangles: I32, truth: Truth) -> dict[str, Any]:
    """The figures of a mesh in the world of the truth: triangles, and per part accuracy in metres (mean, RMSE, 95 %) and completeness within
    WITHIN_M. A point of the mesh belongs to the part that is nearest to it."""
    import numpy as np

    from trihedron.tools.mesh_distance import NearestTriangle, sampled

    points, _, area = sampled(vertices, triangles, SAMPLE_M)
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


def report(figures: dict[str, Any]) -> str:
    """The figures as a table for people."""
    rows = [["", "mean cm", "RMSE cm", "95 % cm", *(f"within {1e2 * limit:.0f} cm" for limit in WITHIN_M)]]
    for part, found in figures["parts"].items():
        centimetres = [_number(found[name], 1e2, "{:.2f}") for name in ("mean_m", "rmse_m", "p95_m")]
        rows.append([part, *centimetres, *(_number(found[f"within_{1e2 * limit:.0f}_cm"], 1.0, "{:.1%}") for limit in WITHIN_M)])
    return "\n".join([table(rows, "lrrrrr"), f"{figures['triangles']} triangles, {figures['area_m2']:.1f} m², {figures['bytes']} bytes"])


def _number(value: float | None, factor: float, form: str) -> str:
    return "-" if value is None else form.format(value * factor)
