"""Compare estimators of the Manhattan frame over one recording: a table, the errors against frame, and the sphere of one frame.

FOLDER is of `trihedron ablate RUN.mcap 'manhattan=*' feedback=recorded`, which draws the same pictures. The truth is the one rotation from the
scene's axes to the world that the claims of all runs agree on best, carried into each camera by the ground truth of the poses. An error is that of
the nearest frame in view; a claim more than 3° off is false. NEES is the median of the others, 2.37 (χ² with three degrees of freedom) when their
covariance is right. Times are those of the replay.

Example: trihedron benchmark rotations runs/axes --frame 60
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trihedron.comparison.axes import FALSE_DEG, RIGHT_DEG, common_world, draw, read_runs
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Print the table and the names of the pictures; returns the exit code. Raises DataError when there is nothing to compare."""
    parser = Parser("benchmark rotations", __name__)
    parser.add_argument("folder", type=Path, help="of the alternatives")
    parser.add_argument("--frame", type=int, metavar="N", help="whose sphere is drawn (default: the middle one)")
    options = parser.parse(argv)
    print(compare(options.folder, options.frame))
    return 0


def compare(folder: Path, frame: int | None = None) -> str:
    """The table of all runs in `folder` and the paths of the pictures written there. Raises DataError when nothing can be compared."""
    runs = read_runs(folder, [folder, *sorted(path.parent for path in folder.glob(f"*/{RECORDING}"))])
    world = common_world(runs)
    errors = [run.errors_deg(world) for run in runs]
    written = draw(runs, world, errors, folder, frame=frame)
    heads = ["estimator", "frames", "claimed", "within 1°", "false", "median (deg)", "p95 (deg)", "max (deg)", "NEES", "p50 ms"]
    rows: list[list[str]] = []
    for run, error in zip(runs, errors):
        known = error[np.isfinite(error)]
        shares = [np.isfinite(error), error <= RIGHT_DEG, error > FALSE_DEG]
        largest = [np.median(known), np.percentile(known, 95), known.max()] if len(known) else []
        cells = [*(f"{share.mean():.3f}" for share in shares), *([f"{x:.3f}" for x in largest] or ["-"] * 3)]
        last = [f"{x:.2f}" if np.isfinite(x) else "-" for x in (run.nees(world), run.p50_ms)]
        rows.append([run.name, str(len(error)), *cells, *last])
    return "\n".join([table([heads, *rows], "lrrrrrrrrr"), *(str(path) for path in written)])
