"""Write static pages of results: every cell with its spread, its verdict, whether it reproduces the paper, its runs, and the command for them.

The pages need no network and no script but for the 3D view. RUNS are run folders or sweeps. A band is a list of cells with the least and the largest
value allowed; --check exits with 1 when a cell leaves it, --write-band writes the band of these runs.

Example: trihedron site runs/table --out results/
Example: trihedron site runs/small --out results/ --check band.yaml
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from trihedron.comparison.run_samples import COLUMNS
from trihedron.comparison.run_tables import COMPARED, FIGURES, TRACKED, figure_text, spread_text
from trihedron.comparison.runs import Run, groups_of, read_runs, row_of, samples_of, spread_of
from trihedron.comparison.verdicts import Verdict, line_of, verdicts_of
from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean
from trihedron.pipeline.core.files import MAX_YAML_BYTES, YamlError, make_folder, parse_yaml, read_text, write_file
from trihedron.tools import published
from trihedron.tools.arguments import Parser
from trihedron.tools.pages import render
from trihedron.tools.row_labels import data_labels, system_labels
from trihedron.tools.run_configurations import changed_options
from trihedron.tools.run_pages import RunFacts, facts_of, run_page
from trihedron.tools.site_ablations import Ablation, ablation_page, ablations_of

SIGMA, VERDICT = "σ mm†", "verdict on ATE‡"
SHOWN = [TRACKED, COMPARED, SIGMA, "RPE 1 s mm", "RPE 1 s deg", "end to start mm", "surface mm", "p50 ms"]
TOLERANCE = 0.1  # of the published figure, which has no spread of its own
ROUNDING_MM = 0.5  # the paper gives three decimals of a metre
LEAST_TRACKED = 90.0  # percent; the error over fewer frames is no figure of the sequence
BAND_SHARE = 0.25  # of a cell's median, around it, in a band that is written; the spread where that is larger
BAND_COLUMNS = [TRACKED, COMPARED]
NOTES = {
    "±": "A figure is the median over the runs of a row, which differ in their seeds alone, ± half the distance from the smallest to the largest.",
    "†": "Median, over the poses with the status ok, of the σ that a run states of its positions: the root of the trace of their covariance, which"
    " compares with ATE.",
    "‡": "Against the row that is the baseline: better, worse, equal, no difference shown or too short to tell, as trihedron compare --baseline"
    " states it, over the runs with the same seeds or, of a single one, over its frames. In a table where nothing differs, the chance of any better"
    " or worse is 5 %. Below a table are the differences in all figures with their 95 % intervals.",
}


@dataclass(frozen=True)
class Badge:
    """Relation of a cell to the published figure. The sign and the text say it without colour."""

    kind: str
    sign: str
    text: str


REPRODUCES, BETTER, WORSE, NOT_COMPARABLE = "reproduces", "differs: better", "differs: worse", "not comparable"
LEGEND = [
    (Badge("reproduces", "✓", REPRODUCES), "the published figure lies within the spread of the runs, at least within a tenth of itself"),
    (Badge("differs", "▼", BETTER), "the error is smaller than the published one by more than that"),
    (Badge("differs", "▲", WORSE), "the error is larger than the published one by more than that"),
    (Badge("none", "–", NOT_COMPARABLE), "the paper has no figure for these frames or this system; the reason stands beside it"),
]


@dataclass(frozen=True)
class Cell:
    """The runs of one system on one data set, the labels of both, their row of the table, and what the paper has."""

    data: str
    change: str
    system: str
    title: str
    facts: tuple[RunFacts, ...]
    row: dict[str, Any]
    badge: Badge


def main(argv: list[str]) -> int:
    """Write the pages; returns 1 when --check finds a cell outside its band. Raises DataError when there are no runs or the band is wrong."""
    parser = Parser("site", __name__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="RUNS", help="of sweeps, or of single runs")
    parser.add_argument("--out", type=Path, default=Path("results"), metavar="FOLDER", help="default results")
    parser.add_argument("--title", default="Trihedron: results", help="of the first page")
    parser.add_argument("--baseline", default="", metavar="SYSTEM", help="the row that verdicts are against; default: without words, or the first")
    parser.add_argument("--check", type=Path, metavar="BAND", help="exit with 1 when a cell leaves its band")
    parser.add_argument("--write-band", type=Path, metavar="BAND", help="write the band of these runs")
    parser.add_argument("--no-pictures", action="store_true", help="leave out the pictures of frames")
    options = parser.parse(argv)
    cells = cells_of(read_runs(*options.folders))
    if options.baseline and options.baseline not in (systems := {cell.system for cell in cells}):
        raise UsageError("--baseline", f"no row is '{options.baseline}'", did_you_mean(options.baseline, systems))
    outside = band_failures(read_band(options.check), cells) if options.check else {}
    write_site(cells, options.out, options.title, outside, not options.no_pictures, ablations_of(options.folders), options.baseline)
    if options.write_band:
        write_file(options.write_band, yaml.safe_dump(band_of(cells), sort_keys=False, allow_unicode=True))
    print(options.out / "index.html")
    for failure in outside.values():
        print(f"outside its band: {failure}")
    return 1 if outside else 0


def cells_of(runs: Sequence[Run]) -> list[Cell]:
    """Return the cells of runs: those of one data set stand together."""
    facts = {run.folder: facts_of(run) for run in runs}
    groups = {place: tuple(facts[run.folder] for run in same) for place, same in groups_of(runs).items()}
    firsts = [known[0] for known in groups.values()]
    cells = []
    for ((data, change), known), system, title in zip(groups.items(), system_labels(firsts), data_labels(firsts)):
        row = row_of(data, change, [one.run for one in known])
        cells.append(Cell(data, change, system, title, known, row, badge_of(known[0], row)))
    return cells


def badge_of(facts: RunFacts, row: dict[str, Any]) -> Badge:
    """Compare a row with the paper's Table I."""

    def none(reason: str) -> Badge:
        return Badge("none", "–", f"{NOT_COMPARABLE}: {reason}")

    sequence = published.sequence_of(facts.folder_name)
    if sequence is None:
        return none("no sequence of the paper")
    whole = published.sequences()[sequence].get("frames", 0)
    graph = "structural_paper" if facts.graph == "structural" else facts.graph
    figure = published.published_ate_m(sequence, graph)
    if graph not in published.paper()["systems"]:
        return none("the paper has no such system")
    if figure is None:
        return none("the paper has no figure, or its system was lost")
    if COMPARED not in row["figures"]:
        return none("no error was computed")
    if facts.frames < published.WHOLE * whole:
        return none(f"{facts.frames} of about {whole} frames")
    if row["figures"].get(TRACKED, {"median": 0.0})["median"] < LEAST_TRACKED:
        return none(f"less than {LEAST_TRACKED:g} % tracked")
    found, expected = row["figures"][COMPARED], 1e3 * figure
    slack = max(0.5 * (found["max"] - found["min"]), TOLERANCE * expected, ROUNDING_MM)
    if abs(found["median"] - expected) <= slack:
        return Badge("reproduces", "✓", f"{REPRODUCES} {expected:g} mm")
    better = found["median"] < expected
    return Badge("differs", "▼" if better else "▲", f"{BETTER if better else WORSE} than {expected:g} mm")


def write_site(
    cells: Sequence[Cell],
    out: Path,
    title: str,
    outside: dict[tuple[str, str], str] | None = None,
    pictures: bool = True,
    ablations: Sequence[Ablation] = (),
    baseline: str = "",
) -> None:
    """Write index.html and a page for each run and each ablation into a folder; verdicts are against the system `baseline`, see `verdicts_in`."""
    from trihedron.tools.paper import tables_of

    out.mkdir(parents=True, exist_ok=True)
    make_folder(out / "runs")
    commits = Counter(facts.commit for cell in cells for facts in cell.facts if facts.commit)
    commit = commits.most_common(1)[0][0] if commits else ""
    names = _page_names(cells)
    columns = [name for name in SHOWN if any(_text(cell, name) != "-" for cell in cells)]
    for cell in cells:
        for facts in cell.facts:
            title_of_run = f"{cell.system}, {cell.title}"
            page = run_page(facts, title_of_run, facts.commit != commit, pictures, changed_options({"value": facts}))
            write_file(out / "runs" / f"{names[facts.run.folder]}.html", page)
    for ablation in ablations:
        make_folder(out / "ablations")
        write_file(out / "ablations" / f"{ablation.name}.html", ablation_page(ablation, pictures))
    groups = [_group([cell for cell in cells if cell.data == data], columns, names, commit, outside or {}, baseline) for data in _data_of(cells)]
    page = render(
        "index.html",
        title=title,
        runs=sum(len(cell.facts) for cell in cells),
        made_by=_made_by(cells, commit),
        legend=LEGEND,
        notes=NOTES,
        commits=sorted(found[:10] for found in commits),
        commit=commit[:10],
        tables=tables_of([(cell.facts[0], cell.row) for cell in cells]),
        groups=groups,
        ablations=ablations,
        sources=[f"{published.paper()['source']}; {published.paper()['machine']}", f"{published.peers()['source']}; {published.peers()['machine']}"],
    )
    write_file(out / "index.html", page)


def _made_by(cells: Sequence[Cell], commit: str) -> str:
    versions = sorted({facts.version for cell in cells for facts in cell.facts if facts.version})
    return f"trihedron {', '.join(versions) or 'of an unknown version'}, commit {commit[:10] or 'unknown'}"


def _data_of(cells: Sequence[Cell]) -> list[str]:
    return list(dict.fromkeys(cell.data for cell in cells))


def _page_names(cells: Sequence[Cell]) -> dict[Path, str]:
    """Return a file name for each run: a number, and what it is."""
    runs = [(cell, facts) for cell in cells for facts in cell.facts]
    slugs = [re.sub(r"[^a-z0-9]+", "-", f"{cell.system} {cell.title}".lower()).strip("-")[:60] for cell, _ in runs]
    return {facts.run.folder: f"{number:03}-{slug}" for number, ((_, facts), slug) in enumerate(zip(runs, slugs))}


def verdicts_in(cells: Sequence[Cell], baseline: str = "") -> tuple[Cell, list[Verdict]]:
    """Return the baseline of a table and the verdict of each other cell against it in each figure. It is the cell of the system `baseline` where the
    table has one, else the one without words of its own, else the first."""
    base = min(cells, key=lambda cell: (cell.system != baseline, cell.change != ""))
    pairs = {(base.system, cell.system): samples_of(_runs(cell), _runs(base)) for cell in cells if cell is not base}
    return base, verdicts_of(pairs, COLUMNS)


def _runs(cell: Cell) -> list[Run]:
    return [facts.run for facts in cell.facts]


def _text(cell: Cell, column: str) -> str:
    if column != SIGMA:
        return figure_text(cell.row, column)
    known = [facts.sigma_mm for facts in cell.facts if np.isfinite(facts.sigma_mm)]
    return spread_text(spread_of(known), FIGURES[COMPARED].decimals) if known else "-"


def _group(
    cells: Sequence[Cell], columns: Sequence[str], names: dict[Path, str], commit: str, outside: dict[tuple[str, str], str], baseline: str
) -> dict[str, Any]:
    first, data = cells[0].facts[0], cells[0].data
    base, verdicts = verdicts_in(cells, baseline)
    answers = {one.second: one.answer.partition(";")[0] for one in verdicts if one.figure == COMPARED} | {base.system: "the baseline"}
    verdict = [VERDICT] if len(cells) > 1 else []
    shown = []
    for cell in cells:
        links = [
            {"href": f"runs/{names[facts.run.folder]}.html", "name": f"#{number + 1}", "other": facts.commit != commit}
            for number, facts in enumerate(cell.facts)
        ]
        texts = [_text(cell, name) for name in columns] + [answers.get(cell.system, "-") for _ in verdict]
        band = outside.get((cell.data, cell.change), "")
        shown.append({"system": cell.system, "texts": texts, "badge": cell.badge, "band": band, "note": cell.row["note"], "links": links})
    title = cells[0].title
    return {
        "id": re.sub(r"[^a-z0-9]+", "-", f"data-{title} {data}".lower()).strip("-"),
        "title": title,
        "note": f"{first.frames} frames" + (f"; {data}" if data else ""),
        "columns": [*columns, *verdict],
        "cells": shown,
        "verdicts": [line_of(one, COLUMNS[one.figure]) for one in verdicts],
        "peers": [_peer(name, figures, [*columns, *verdict]) for name, figures in published.peer_figures(first.folder_name, first.frames).items()],
    }


def _peer(name: str, figures: dict[str, Any], columns: Sequence[str]) -> dict[str, Any]:
    """Return the row of another program, measured on the same frames; its runs are not there, so that it has no verdict."""
    ate = [1e3 * value for value in figures.get("ate_m", ())]
    known = {
        COMPARED: f"{0.5 * (max(ate) + min(ate)):.2f}" + (f" ±{0.5 * (max(ate) - min(ate)):.2f}" if len(ate) > 1 else "") if ate else "-",
        "RPE 1 s mm": f"{1e3 * figures['rpe_second_m']:.2f}" if "rpe_second_m" in figures else "-",
        "RPE 1 s deg": f"{figures['rpe_second_deg']:.3f}" if "rpe_second_deg" in figures else "-",
        "p50 ms": f"{figures['ms']:.1f}" if "ms" in figures else "-",
    }
    return {"name": name, "texts": [known.get(column, "-") for column in columns], "note": figures.get("note", "on the same frames")}


def band_of(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return the band of some runs: for each cell and figure the least and the largest value allowed."""
    band = []
    for cell in cells:
        for name in BAND_COLUMNS:
            if name in cell.row["figures"]:
                found = cell.row["figures"][name]
                slack = max(found["max"] - found["min"], BAND_SHARE * found["median"]) if FIGURES[name].error else 1.0
                low, high = max(found["median"] - slack, 0.0), found["median"] + slack
                band.append({"data": cell.data, "change": cell.change, "figure": name, "low": round(low, 3), "high": round(high, 3)})
    return band


def read_band(path: Path) -> list[dict[str, Any]]:
    """Read a band. Raises DataError."""
    try:
        found = parse_yaml(read_text(path, MAX_YAML_BYTES))
    except YamlError as error:
        raise DataError(str(path), f"is a text {error}", "write it by --write-band") from error
    keys = {"data", "change", "figure", "low", "high"}
    if not isinstance(found, list) or not all(isinstance(entry, dict) and keys == set(entry) and entry["figure"] in FIGURES for entry in found):
        raise DataError(str(path), f"is not a list of cells with {', '.join(sorted(keys))}", "write it by --write-band")
    if not all(isinstance(entry[key], (int, float)) for entry in found for key in ("low", "high")):
        raise DataError(str(path), "has a bound that is not a number", "write it by --write-band")
    return found


def band_failures(band: Sequence[dict[str, Any]], cells: Sequence[Cell]) -> dict[tuple[str, str], str]:
    """Return a line for each cell outside its band, by data and change; a cell of the band that is not there, or has no figure, is outside."""
    known = {(cell.data, cell.change): cell for cell in cells}
    failures: dict[tuple[str, str], list[str]] = {}
    for entry in band:
        key, name = (str(entry["data"]), str(entry["change"])), entry["figure"]
        place = " ".join(part for part in (*key, name) if part)
        found = known[key].row["figures"].get(name) if key in known else None
        bounds = f"{entry['low']:g} to {entry['high']:g}"
        if found is None:
            failures.setdefault(key, []).append(f"{place}: has no value, {bounds} is its band")
        elif not entry["low"] <= found["median"] <= entry["high"]:
            failures.setdefault(key, []).append(f"{place}: {found['median']:.{FIGURES[name].decimals}f} instead of {bounds}")
    return {key: "; ".join(lines) for key, lines in failures.items()}
