"""Judge how honest status and covariances are: sensors in rooms by seeds, faults, and recorded sequences, in one table.

Rows: each sensor (over rooms and seeds), each room (over sensors and seeds), each recorded sequence given (whole), each case of degenerate input, and
all clean runs, which are those without a fault. Columns:
  ok %, lost %  share of the frames; of clean runs, what is not ok is a false alarm, and a second table counts these by the test that failed
  wrong ok      ok frames that are off by more than 5 cm and 4 σ, or by more than 2° and 4 σ, after the alignment of ATE and after that of NEES
  ATE mm        of the posed frames as estimated at the time, each sub-map aligned by itself
  NEES          median over the frames, 6 degrees of freedom; honest: 5.35
  in 95 %       frames below the 95 % limit of NEES; honest: 95
  AUC           of "error above its median" by σ, after the alignment that the covariances make most likely, as NEES; 0.5 is chance
  log-lik       mean log-likelihood of an error, in nats
  σ/error       sharpness against error: the root of the mean stated variance of the position over the root mean square of its error (spread–skill
                ratio); honest: 1, less is overconfident
A last line has the rank correlation of the σ that runs of simulated sensors state with their ATE.
A figure is the mean over runs, geometric of NEES and σ/error, with a 95 % interval (Student's t) where there are three runs or more. Seeds begin
behind those that the program was developed with (0 to 4); a fault is run with the first. --runs keeps the runs in a folder, and takes from it what
was run with the same words. Other words with = are overrides of each run. Empty names, as in --cases "", leave a part out.

Example: trihedron benchmark honesty ../shared/data/*/ --runs runs/honesty --json honesty.json
"""

from __future__ import annotations

import json
import re
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.layouts import layout_of
from trihedron.pipeline.sweep.sweep import words_of_sequence
from trihedron.tools.arguments import Parser
from trihedron.tools.benchmarks.fault_benchmark import CASES, fault_cases
from trihedron.tools.benchmarks.judged_runs import Case, alarms_of, judged_cases, kept_or_temporary, plain, rank_by_sigma, report, rows_of
from trihedron.tools.benchmarks.sensor_benchmark import add_arguments, sensor_cases

COMMAND = "benchmark honesty"
PATH = "dataset.path="
ROOMS = "room,bare,fast"
SEEDS, FIRST_SEED = 5, 10


def main(argv: list[str]) -> int:
    """Print the table; returns 0. Raises UsageError for what is not known, TrihedronError for a run that fails."""
    parser = Parser(COMMAND, __name__)
    parser.add_argument("data", nargs="*", help="folders of sequences, or KIND:FOLDER KEY=VALUE ... in quotes")
    add_arguments(parser, ROOMS, SEEDS, FIRST_SEED)
    parser.add_argument("--cases", default=",".join(CASES), metavar="A,B", help=f"faults (default: {','.join(CASES)})")
    parser.add_argument("--size", default="640x480", metavar="WxH", help="of simulated images (default: 640x480)")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="keep the runs here, and judge those that are there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows, the false alarms and the figures of each run")
    options, rest = parser.parse_known_args(argv)
    words = [*options.data, *rest]
    data = [word for word in words if not is_override(word)]
    cases = all_cases(options, data, [word for word in words if is_override(word)])
    with kept_or_temporary(options.runs) as folder:
        found = list(judged_cases(cases, folder))
    print("\n" + report(found))
    if options.json:
        content = {"rows": rows_of(found), "alarms": alarms_of(found), "rank": rank_by_sigma(found), "runs": [plain(one) for one in found]}
        write_file(options.json, json.dumps(content, indent=2, ensure_ascii=False) + "\n")
    return 0


def is_override(word: str) -> bool:
    """Return True for key=value, False for a folder and for KIND KEY=VALUE or KIND:FOLDER KEY=VALUE."""
    key, equals, _ = word.partition("=")
    return bool(equals) and not {":", " "} & set(key) and not Path(word).exists()


def all_cases(options: Namespace, data: Sequence[str], overrides: Sequence[str]) -> list[Case]:
    """Return the runs of all parts, each under a name of its own. Raises UsageError, and DataError for a folder that is not there."""
    width, height = size_of(options.size)
    sensors = sensor_cases(COMMAND, options, [f"dataset.width={width}", f"dataset.height={height}", *overrides])
    size = [f"+dataset.options.width={width}", f"+dataset.options.height={height}"]
    faults = fault_cases(options.cases, [*size, *overrides], options.first_seed)
    return [*sensors, *(sequence_case(text, overrides) for text in map(sequence_text, data)), *faults]


def size_of(text: str) -> tuple[int, int]:
    """Return width and height of WxH. Raises UsageError."""
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UsageError(COMMAND, f"--size {text} is not WxH", "give two numbers, for example 640x480")
    return int(width), int(height)


def sequence_text(word: str) -> str:
    """Return KIND:FOLDER for a folder, whose kind is that of its files; any other word as it is. Raises DataError."""
    return word if ":" in word or "=" in word else f"{layout_of(Path(word))}:{word.rstrip('/')}"


def sequence_case(text: str, overrides: Sequence[str]) -> Case:
    """Return the run of a sequence, which is named by its folder, and by its options too where it has some."""
    kind, *words = words_of_sequence(text)
    path = next((word for word in words if word.startswith(PATH)), None)
    folder = kind.removeprefix("dataset=") if path is None else Path(path.removeprefix(PATH).strip("'\"")).name
    name = " ".join([folder, *(word.removeprefix("dataset.") for word in words if word != path)])
    return Case(re.sub(r"[^\w.=-]+", "_", f"sequence-{name}"), [kind, *words, "outputs=[trajectory]", *overrides], {"sequence": name})
