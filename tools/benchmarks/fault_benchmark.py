"""Judge the status of poses under degenerate input: each case is a run of `dataset=faults`, one row of one table.

Columns are those of `trihedron benchmark honesty`, which has these rows beside those of clean runs. Poses are compared without a change of scale.
--runs keeps the runs in a folder, and judges those it holds already, without another run. Other words are overrides of `trihedron run`; options of
the data set underneath are +dataset.options.NAME=VALUE.

Example: trihedron benchmark faults --cases frozen_depth,black_color
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from trihedron.pipeline.core.files import write_file
from trihedron.tools.arguments import Parser
from trihedron.tools.benchmarks.judged_runs import FAULT, Case, check_overrides, chosen, judged_cases, kept_or_temporary, plain, report

LENGTH = 90  # frames of the data set underneath where the case states none
CASES = {  # name -> what the data set is given
    "none": (),
    "frozen_depth": ("dataset.freeze=30:60", "dataset.frozen=depth"),
    "frozen_color": ("dataset.freeze=30:60", "dataset.frozen=color"),
    "frozen": ("dataset.freeze=30:60",),
    "frozen_color_with_noise": ("dataset.freeze=30:60", "dataset.frozen=color", "dataset.color_noise=2"),
    "partly_frozen_color": ("dataset.freeze=30:60", "dataset.frozen=color", "dataset.frozen_share=0.7"),
    "partly_frozen": ("dataset.freeze=30:60", "dataset.frozen_share=0.7"),
    "shuffled_color": ("dataset.shuffle=true",),
    "random_color": ("dataset.cover=30:60", "dataset.covered=color", "dataset.cover_with=random"),
    "black_color": ("dataset.cover=30:60", "dataset.covered=color"),
    "always_black": ("dataset.cover=0:", "dataset.covered=color"),
    "teleport": ("dataset.drop=30:210", "+dataset.options.length=270", "+dataset.options.motion=fast"),
    "jump_90_degrees": ("dataset.drop=30:165", "+dataset.options.length=225", "+dataset.options.motion=pan"),
    "every_tenth": ("dataset.every=10", "+dataset.options.length=600"),
    "every_tenth_fast": ("dataset.every=10", "+dataset.options.length=600", "+dataset.options.motion=fast"),
    "wrong_scale_for_a_second": ("dataset.depth_times=1.2", "dataset.during=30:60"),
    "slightly_wrong_scale": ("dataset.depth_times=1.07", "dataset.during=30:"),
    "wrong_focal_length": ("dataset.focal_times=1.2",),
    "mirrored_color": ("dataset.mirror=true",),
    "mirrored_for_a_second": ("dataset.mirror=true", "dataset.during=30:60"),
    "two_recordings": ("dataset.join=45", "+dataset.joined.seed=1", "+dataset.joined.slanted=true"),
}


def main(argv: list[str]) -> int:
    """Print the table; returns 0. Raises UsageError for an unknown case, TrihedronError for a run that fails."""
    parser = Parser("benchmark faults", __name__)
    parser.add_argument("--cases", default=",".join(CASES), metavar="A,B", help=f"(default: {','.join(CASES)})")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="keep the runs here, and judge those that are there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures of each case")
    options, overrides = parser.parse_known_args(argv)
    check_overrides("benchmark faults", overrides)
    with kept_or_temporary(options.runs) as folder:
        found = list(judged_cases(fault_cases(options.cases, overrides), folder))
    print("\n" + report(found))
    if options.json:
        write_file(options.json, json.dumps([plain(one) for one in found], indent=2) + "\n")
    return 0


def fault_cases(names: str, overrides: Sequence[str], seed: int = 0) -> list[Case]:
    """Return the runs of the cases A,B with a seed of the room underneath. Raises UsageError for an unknown one."""
    words = [*overrides, *([f"+dataset.options.seed={seed}"] if seed else [])]
    return [Case(name, words_of(name, words), {FAULT: name}, seed) for name in chosen(names, CASES)]


def words_of(case: str, overrides: Sequence[str] = ()) -> list[str]:
    """Overrides of the run of a case."""
    own = any("options.length" in word for word in CASES[case])
    length = () if own else (f"+dataset.options.length={LENGTH}",)
    return ["dataset=faults", *length, *CASES[case], "outputs=[trajectory]", *overrides]
