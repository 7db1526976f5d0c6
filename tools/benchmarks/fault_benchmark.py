"""Judge the status of poses under degenerate input: each case is a run of `dataset=faults`, one row of one table.

Columns: frames, those ok, degraded and lost, ATE of the posed frames (as estimated at the time, each sub-map aligned by itself), the largest error of
an ok frame, and wrong ok: ok frames that are off by more than 5 cm and 4 σ, or 2° and 4 σ. Poses are compared
without a change of scale. --runs keeps the runs in a folder, and judges those it holds already, without another run. Other words are overrides of
`trihedron run`; options of the data set underneath are +dataset.options.NAME=VALUE.

Example: trihedron benchmark faults --cases frozen_depth,black_color
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.text_table import table
from trihedron.tools.arguments import Parser
from trihedron.tools.benchmarks.sensor_benchmark import Judged, chosen, run_and_judge

LENGTH = 90  # frames of the data set underneath where the case states none
CASES = {  # name -> what the data set is given
    "none": (),
    "frozen_depth": ("dataset.freeze=30:60", "dataset.frozen=depth"),
    "frozen_color": ("dataset.freeze=30:60", "dataset.frozen=color"),
    "frozen": ("dataset.freeze=30:60",),
    "shuffled_color": ("dataset.shuffle=true",),
    "random_color": ("dataset.cover=30:60", "dataset.covered=color", "dataset.cover_with=random"),
    "black_color": ("dataset.cover=30:60", "dataset.covered=color"),
    "always_black": ("dataset.cover=0:", "dataset.covered=color"),
    "teleport": ("dataset.drop=30:210", "+dataset.options.length=270", "+dataset.options.motion=fast"),
    "jump_90_degrees": ("dataset.drop=30:165", "+dataset.options.length=225", "+dataset.options.motion=pan"),
    "every_tenth": ("dataset.every=10", "+dataset.options.length=600"),
    "every_tenth_fast": ("dataset.every=10", "+dataset.options.length=600", "+dataset.options.motion=fast"),
    "wrong_scale_for_a_second": ("dataset.depth_times=1.2", "dataset.during=30:60"),
    "wrong_focal_length": ("dataset.focal_times=1.2",),
    "mirrored_color": ("dataset.mirror=true",),
    "mirrored_for_a_second": ("dataset.mirror=true", "dataset.during=30:60"),
    "two_recordings": ("dataset.join=45", "+dataset.joined.seed=1", "+dataset.joined.slanted=true"),
}
HEADER = ["case", "frames", "ok", "degraded", "lost", "ATE mm", "largest ok mm", "wrong ok", "NEES"]


def main(argv: list[str]) -> int:
    """Print the table; returns 0. Raises UsageError for an unknown case, TrihedronError for a run that fails."""
    parser = Parser("benchmark faults", __name__)
    parser.add_argument("--cases", default=",".join(CASES), metavar="A,B", help=f"(default: {','.join(CASES)})")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="keep the runs here, and judge those that are there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures of each case")
    options, overrides = parser.parse_known_args(argv)
    for word in overrides:
        if "=" not in word:
            raise UsageError("benchmark faults", f"'{word}' is not key=value", "see trihedron benchmark faults --help")
    found: dict[str, Judged] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder: Path = options.runs or Path(temporary)
        for case in chosen(options.cases, CASES):
            found[case] = run_and_judge(folder / case, words_of(case, overrides))
    print(table([HEADER, *(row_of(case, judged) for case, judged in found.items())], "lrrrrrrrr"))
    if options.json:
        options.json.write_text(json.dumps({case: check.to_dict() for case, (check, _) in found.items()}, indent=2) + "\n")
    return 0


def words_of(case: str, overrides: Sequence[str] = ()) -> list[str]:
    """Overrides of the run of a case."""
    own = any("options.length" in word for word in CASES[case])
    length = () if own else (f"+dataset.options.length={LENGTH}",)
    return ["dataset=faults", *length, *CASES[case], "outputs=[trajectory]", *overrides]


def row_of(case: str, judged: Judged) -> list[str]:
    """Fill the row of a case."""
    check, errors = judged
    ok = errors.error_m[errors.ok & errors.judged]
    ate = "-" if check.ate_m is None else f"{1e3 * check.ate_m:.1f}"
    largest = f"{1e3 * float(np.max(ok)):.1f}" if len(ok) else "-"
    nees = "-" if check.nees_median is None else f"{check.nees_median:.1f}"
    return [case, *(str(n) for n in (check.frames, check.ok, check.degraded, check.lost)), ate, largest, str(check.wrong_ok), nees]
