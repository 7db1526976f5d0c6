"""Judge runs by sensors of several kinds: errors, how honest the stated covariances are, and frames that are `ok` and wrong.

Each sensor records each room, with --seeds sensors of its kind (their hidden parameters, and the path through the room, differ by the seed). Columns
are those of `trihedron benchmark honesty`, which has these rows beside those of faults and sequences. With --quality, runs are judged without the
truth, too (`trihedron evaluate RUN --no-reference`), and the rank correlation of each such figure with the ATE is printed. --runs keeps the runs in a
folder, and judges those that it holds already without running them again. Other words are overrides of `trihedron run`.

Example: trihedron benchmark sensors --sensors kinect_v1,phone --rooms room --seeds 1 --length 60
"""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.text_table import table
from trihedron.tools.arguments import Parser
from trihedron.tools.benchmarks.judged_runs import (
    SENSOR,
    Case,
    JudgedCase,
    check_overrides,
    chosen,
    judged_cases,
    kept_or_temporary,
    plain,
    rank_correlation,
    report,
)

SENSORS = ("kinect_v1", "tof", "realsense_stereo", "hololens", "phone")
ROOMS = {  # name -> what the data set is given
    "room": (),
    "bare": ("dataset.texture=false",),
    "slanted": ("dataset.slanted=true", "dataset.curved=true"),
    "fast": ("dataset.motion=fast",),
    "offices": ("dataset.scene=offices",),
    "corridor": ("dataset.scene=corridor",),
    "flat": ("dataset.scene=flat",),
}
USUAL_ROOMS = "room,bare,fast,offices"
COUNTS = ("frames", "posed", "parts")  # of a run judged without truth: no measures of its quality


def main(argv: list[str]) -> int:
    """Print the table; returns 0. Raises UsageError for an unknown sensor or room, TrihedronError for a run that fails."""
    parser = Parser("benchmark sensors", __name__)
    add_arguments(parser, USUAL_ROOMS, 2, 0)
    parser.add_argument("--quality", action="store_true", help="judge the runs without truth, too")
    parser.add_argument("--runs", type=Path, metavar="FOLDER", help="keep the runs here, and judge those that are there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures of each run, with the hidden parameters")
    options, overrides = parser.parse_known_args(argv)
    check_overrides("benchmark sensors", overrides)
    with kept_or_temporary(options.runs) as folder:
        found = list(judged_cases(sensor_cases("benchmark sensors", options, overrides), folder))
        quality = [_quality(folder / one.case.name) if options.quality else {} for one in found]
    print("\n" + report(found))
    if options.quality:
        print("\n" + correlations([(figures, one.check.ate_m) for figures, one in zip(quality, found, strict=True)]))
    if options.json:
        rows = [{**plain(one), "quality": figures, "hidden": _hidden(one)} for figures, one in zip(quality, found, strict=True)]
        write_file(options.json, json.dumps(rows, indent=2) + "\n")
    return 0


def add_arguments(parser: ArgumentParser, rooms: str, seeds: int, first_seed: int) -> None:
    """Add the options that choose the runs, with these defaults."""
    parser.add_argument("--sensors", default=",".join(SENSORS), metavar="A,B", help=f"(default: {','.join(SENSORS)})")
    parser.add_argument("--rooms", default=rooms, metavar="A,B", help=f"some of {', '.join(ROOMS)} (default: {rooms})")
    parser.add_argument("--seeds", type=int, default=seeds, metavar="N", help=f"sensors of each kind (default: {seeds})")
    parser.add_argument("--first-seed", type=int, default=first_seed, metavar="N", help=f"seed of the first (default: {first_seed})")
    parser.add_argument("--length", type=int, default=120, metavar="N", help="frames of each run (default: 120)")


def sensor_cases(command: str, options: Namespace, overrides: Sequence[str]) -> list[Case]:
    """Return the runs of each sensor in each room with each seed. Raises UsageError for unknown names and for numbers out of range."""
    if not (1 <= options.seeds <= 100 and 0 <= options.first_seed <= 10_000 and 10 <= options.length <= 100_000):
        cure = "give 1 to 100 seeds, the first from 0 to 10000, and 10 to 100000 frames"
        raise UsageError(command, "--seeds, --first-seed or --length is out of range", cure)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    return [
        Case(f"{sensor}-{room}-{seed}", [*words_of(sensor, room, seed, options.length), *overrides], {SENSOR: sensor, "room": room}, seed)
        for sensor in chosen(options.sensors, SENSORS)
        for room in chosen(options.rooms, ROOMS)
        for seed in seeds
    ]


def words_of(sensor: str, room: str, seed: int, length: int) -> list[str]:
    """Overrides of the run of a sensor in a room."""
    own = [f"dataset.sensor={sensor}", f"dataset.sensor_seed={seed}", f"dataset.seed={seed}", f"dataset.length={length}"]
    return ["dataset=simulated_sensor", *own, *ROOMS[room], "outputs=[trajectory]"]


def _quality(run: Path) -> dict[str, float]:
    from trihedron.pipeline.record.reader import Recording
    from trihedron.tools.quality import quality_of_run

    return quality_of_run(Recording(run)).to_dict()


def correlations(found: Sequence[tuple[dict[str, Any], float | None]]) -> str:
    """Make the table of Spearman's rank correlation of each figure without truth with the ATE over the runs (figures, ATE)."""
    names = list(dict.fromkeys(name for figures, _ in found for name in figures if name not in COUNTS))
    rows = [["figure without truth", "rank correlation with ATE", "runs"]]
    for name in names:
        rho, runs = rank_correlation((figures.get(name), ate_m) for figures, ate_m in found)
        rows.append([name, "-" if rho is None else f"{rho:+.2f}", str(runs)])
    return table(rows, "lrr")


def _hidden(one: JudgedCase) -> dict[str, Any]:
    """Return the parameters of the sensor of a run that its stated camera does not tell."""
    from trihedron.datasets.simulation.sensor_models import Sensor, drawn_parameters

    return drawn_parameters(Sensor[one.case.groups[SENSOR]], one.case.seed).to_dict()
