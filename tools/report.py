"""Write one page of HTML about some runs: trajectories, surface and building in 3D, floor plans, errors over time, times of the stages, options
that are not their defaults, and a frame of each run with its features, planes and axes.

The page needs no network. FOLDER is a run, or a sweep.

Example: trihedron report runs/a runs/b --out report.html
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from trihedron.comparison import run_tables
from trihedron.comparison.runs import OVERRIDES, Run, read_runs, rows_of
from trihedron.pipeline.core.errors import DataError, TrihedronError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.run.results import TRAJECTORY
from trihedron.pipeline.run.stated_sigma import CAUSES, dominant_cause
from trihedron.tools.arguments import Parser
from trihedron.tools.pages import render
from trihedron.tools.run_configurations import changed_options
from trihedron.tools.run_pages import MOST_PICTURES, RunFacts, drawings_of, facts_of, frame_picture

TITLE_NAMES = 6
MOST_TRIANGLES = 40_000  # of the page's one surface


def main(argv: list[str]) -> int:
    """Write the page and say where; returns the exit code. Raises DataError when there are no runs."""
    parser = Parser("report", __name__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="of runs, or of a sweep")
    parser.add_argument("--out", type=Path, default=Path("report.html"), metavar="FILE", help="default report.html")
    parser.add_argument("--title", metavar="TEXT", help="default: the data set and the names of the runs")
    options = parser.parse(argv)
    runs = read_runs(*options.folders)
    write_file(options.out, page(runs, options.title))
    print(options.out)
    return 0


def page(runs: Sequence[Run], title: str | None = None) -> str:
    """The whole page, under a title. Raises DataError when no run has a trajectory."""
    named = {name: run for name, run in zip(_names(runs), runs) if all((run.folder / file).exists() for file in (RECORDING, TRAJECTORY))}
    if not named:
        raise DataError(str(runs[0].folder), "none of the runs has a trajectory", "run with 'outputs=[trajectory]'")
    facts = {name: facts_of(run) for name, run in named.items()}
    header, cells = run_tables.cells_of(rows_of(runs))
    return render(
        "report.html",
        title=title or title_of(facts),
        origins=_table("Origins", _note(facts), ["run", "data set", "date", "command"], [*map(_origin, facts, facts.values())]),
        results=_table("Results", "± is half the distance from the smallest to the largest.", header, cells),
        sigmas=_sigmas({name: run.folder for name, run in named.items()}),
        configurations=changed_options(facts),
        frames=[_frame(name, run.folder) for name, run in list(named.items())[:MOST_PICTURES]],
        **drawings_of({name: run.folder for name, run in named.items()}, MOST_TRIANGLES),
    )


def title_of(runs: Mapping[str, RunFacts]) -> str:
    """The data sets of the runs and their names."""
    names = list(runs)
    data = ", ".join(dict.fromkeys(facts.data_set for facts in runs.values()))
    return f"{data}: {', '.join(names[:TITLE_NAMES])}" + (f" and {len(names) - TITLE_NAMES} more" if len(names) > TITLE_NAMES else "")


def _names(runs: Sequence[Run]) -> list[str]:
    """The folders' names, with those above them where one is not enough."""
    names = [run.folder.resolve().name for run in runs]
    return names if len(set(names)) == len(names) else ["/".join(run.folder.resolve().parts[-2:]) for run in runs]


def _note(runs: Mapping[str, RunFacts]) -> str:
    """The sentence above the commands."""
    pushed = " pushed: the images came one by one from a Python program." * any(facts.is_pushed for facts in runs.values())
    return f"The commands as they were given.{pushed}"


def _origin(name: str, facts: RunFacts) -> tuple[str, ...]:
    """Name, data set, date and command of a run; the options of one that a Python program made."""
    date = datetime.fromtimestamp((facts.run.folder / OVERRIDES).stat().st_mtime).astimezone().strftime("%Y-%m-%d %H:%M %Z")
    if facts.is_pushed:
        options = f"the options {shlex.join(facts.words)}" if facts.words else "no options"
        return name, facts.data_set, date, f"none: frames were pushed from Python, into trihedron.Slam with {options}"
    return name, facts.data_set, date, shlex.join(["trihedron", "run", *facts.words])


def _sigmas(folders: Mapping[str, Path]) -> dict[str, Any]:
    """σ that each run states of its ok poses, and what has the largest share of it; without rows where no run states any."""
    found = {name: read_results(folder / "metrics.json").get("sigma") or {} for name, folder in folders.items()}
    header = ("run", "σ mm, median", "worst", "σ deg, median", "worst", "mostly")
    figures = {"median_m": 1e3, "worst_m": 1e3, "median_deg": 1.0, "worst_deg": 1.0}
    rows = []
    for name, sigma in found.items():
        cells = (f"{factor * sigma[key]:.2f}" if sigma.get(key) is not None else "-" for key, factor in figures.items())
        rows.append((name, *cells, CAUSES.get(dominant_cause(sigma), "-")))
    return _table("Stated uncertainty", "σ of the ok poses, and the cause with the largest share of it.", header, rows if any(found.values()) else [])


def _table(title: str, note: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """Return a table as `plain_table` of the templates takes it."""
    return {"title": title, "note": note, "header": header, "rows": rows}


def _frame(name: str, folder: Path) -> dict[str, Any]:
    """The middle frame of a run, as `trihedron picture` draws it, or why there is none."""
    try:
        return {"text": name, "picture": frame_picture(folder)}
    except TrihedronError as error:
        return {"text": f"{name}: {error}"}
