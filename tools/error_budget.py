"""Attribute a run's error to its stages: rerun it with the output of one stage replaced by the truth, and see what remains.

Each row replays the recording: the stages it names are true, every stage that depends on them is computed again, everything else is as recorded.

- `nothing`: the run again, as it was.
- `rotation`, `translation`: the rotation, the position of the decoupled pose is the ground truth's; tracking and mapping start from it.
- `map`: keyframes have their true poses, and landmarks move with the keyframes that observed them (`true_map`). The rows of the map, what it holds
  when, and the noise of its measurements are as recorded. The poses are found in it anew.

Covariances stay as the stages stated them, so that gates and weights do too: a measured ground truth is not exact.

What disappears with a row is the error that enters through that stage; what remains with all of them is that of the refinement on single frames.

Example: trihedron error-budget runs/a/run.mcap
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trihedron.comparison.error_budget import ATE, remarks, reruns, row_name
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Print the table; returns the exit code. Raises DataError for a recording without poses or truth, StageError when a replay fails."""
    parser = Parser("error-budget", __name__)
    parser.add_argument("recording", metavar="RUN.mcap", type=Path, help="of a run whose data set has ground truth")
    found = reruns(Recording(parser.parse(argv).recording))
    rows: list[list[str]] = [["true", "ATE RMSE (m)", "× whole", "RPE over 1 s (m)", "(deg)"]]
    whole = found[()].metrics.get(ATE) or np.nan
    for stages, one in found.items():
        ate, *relative = (_number(one.metrics.get(key)) for key in (ATE, "rpe_second_rmse_m", "rpe_second_rmse_deg"))
        share = (one.metrics.get(ATE) or 0.0) / whole if ATE in one.metrics else np.nan
        rows.append([row_name(stages), ate, f"{share:.2f}" if np.isfinite(share) else "-", *relative])
    print(table(rows, "lrrrr"))
    for sentence in remarks(found):
        print(sentence)
    return 0


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
