"""Print the paper's own tables over some runs, the published figures beside ours: trajectory error, times, refinement, surface and drift.

Sequences of the paper that are not there are named, with the command that gets them; data without published figures have tables of their own. Rows
are labelled by what differs between them. The runs are those of `experiment=paper`, or any others of the same graphs. Surfaces that were not judged
yet are judged against the ground truth of the scene, where there is one.

Example: trihedron run -m experiment=paper out=runs/paper && trihedron paper runs/paper --markdown paper.md
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison.run_tables import COMPARED, figure_text
from trihedron.comparison.runs import groups_of, judge_surfaces, read_runs, row_of
from trihedron.pipeline.core.errors import DataError, RecordingError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth, read_trajectory
from trihedron.pipeline.run.metrics import associate
from trihedron.tools import published
from trihedron.tools.arguments import Parser
from trihedron.tools.row_labels import data_labels, row_labels, system_labels
from trihedron.tools.run_pages import RunFacts, facts_of, read_json

Known = Sequence[tuple[RunFacts, dict[str, Any]]]  # the first run of a cell, and its row
STAGE_GROUPS = {  # column of Table II -> our stages
    "features": ("normals", "keypoints", "lines", "segments", "planes"),
    "rotation": ("manhattan", "tracks", "rotation"),
    "translation": ("translation",),
    "refinement": ("matches", "pose"),
}
WITH, WITHOUT = "structural_paper", "structural_no_refine"
LONG_PATH_M = 20.0  # of a walk whose drift means something
NONE = "-"
OTHER = "Other data"  # than the paper has figures of


@dataclass(frozen=True)
class Table:
    """A table with its title and a note; the first column names the rows."""

    title: str
    note: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def as_markdown(self) -> str:
        """Return the table in Markdown."""
        lines = [self.header, (":--", *["--:"] * (len(self.header) - 1)), *self.rows]
        return f"## {self.title}\n\n{self.note}\n\n" + "".join("| " + " | ".join(text.replace("|", "\\|") for text in row) + " |\n" for row in lines)

    def as_text(self) -> str:
        """Return the table as aligned columns."""
        return f"{self.title}\n{self.note}\n{table([self.header, *self.rows], 'l' + 'r' * (len(self.header) - 1))}"


def main(argv: list[str]) -> int:
    """Print the tables; returns the exit code. Raises DataError when there are no runs."""
    parser = Parser("paper", __name__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="RUNS", help="of sweeps, or of single runs")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables there too")
    parser.add_argument("--no-surfaces", action="store_true", help="do not judge surfaces that were not judged yet")
    options = parser.parse(argv)
    if not options.no_surfaces:
        judge_surfaces(options.folders)
    tables = tables_of(known_of(options.folders))
    print("\n\n".join(found.as_text() for found in tables))
    if options.markdown:
        write_file(options.markdown, "\n".join(found.as_markdown() for found in tables))
    return 0


def known_of(folders: Sequence[Path]) -> Known:
    """Return the cells of the runs in some folders. Raises DataError when there are none."""
    runs = read_runs(*folders)
    return [(facts_of(same[0]), row_of(data, change, same)) for (data, change), same in groups_of(runs).items()]


def tables_of(known: Known) -> list[Table]:
    """Return the paper's tables, filled with the rows of some runs on the sequences that each has published figures of, then those of other data. A
    table without a row of ours is absent, but for Table I."""
    parts = {figure: [_part(known, figure, of_paper) for of_paper in (True, False)] for figure in ("ate_m", "time_ms", "surface_m", "drift_m")}
    (sequences, others), times, surfaces, drifts = parts.values()
    found = [trajectory_table(sequences), time_table(times[0]), refinement_table(sequences), surface_table(surfaces[0]), drift_table(drifts[0])]
    found += [other_trajectory_table(others), time_table(times[1], False), refinement_table(others, False)]
    found += [surface_table(surfaces[1], False), drift_table(drifts[1], False)]
    return [one for one in found if one is not None]


def _part(known: Known, figure: str, of_paper: bool) -> Known:
    """Return the rows on sequences that the paper has this figure of, or all others. Its times are of no single sequence."""
    names = published.sequences() if figure == "time_ms" else published.paper()[figure]
    return [(facts, row) for facts, row in known if (published.sequence_of(facts.folder_name) in names) == of_paper]


def trajectory_table(known: Known) -> Table:
    """Table I: ATE RMSE in mm of our systems and the published ones, a row a sequence of the paper, or each of our data of that sequence."""
    columns, cells = _errors_by_data(known)
    systems = published.paper()["ate_m"]["systems"]
    rows = []
    for sequence, entry in published.sequences().items():
        if sequence not in published.paper()["ate_m"]:
            continue
        values = [NONE if value is None else f"{1e3 * value:g}" for value in published.paper()["ate_m"][sequence]]
        of_it = {data: found for data, found in cells.items() if published.sequence_of(found[0].folder_name) == sequence}
        for data, (facts, ours) in of_it.items():
            whole = facts.frames >= published.WHOLE * entry["frames"]
            note = "whole" if whole else f"{facts.frames} of about {entry['frames']} frames: not comparable"
            rows.append((sequence if len(of_it) == 1 else f"{sequence}, {data}", *ours, *values, note))
        if not of_it:
            rows.append((sequence, *[NONE] * len(columns), *values, f"trihedron download {entry['download']}"))
    header = ("sequence", *columns, *(f"{name}¹" for name in systems), "frames, or how to get them")
    return Table(
        "Table I: trajectory error",
        "ATE RMSE in mm; - is not there, not published, or lost. ¹ as published. Last column: how to get a sequence that is not there.",
        header,
        tuple(rows),
    )


def other_trajectory_table(known: Known) -> Table | None:
    """Return the ATE of our systems on data that the paper has not."""
    columns, cells = _errors_by_data(known)
    rows = [(data, *ours, str(facts.frames)) for data, (facts, ours) in cells.items() if set(ours) != {NONE}]
    return Table(f"{OTHER}: trajectory error", "ATE RMSE in mm.", ("data", *columns, "frames"), tuple(rows)) if rows else None


def _errors_by_data(known: Known) -> tuple[list[str], dict[str, tuple[RunFacts, list[str]]]]:
    """Return the labels of the systems, and of each data, by its label, the run of most frames and a text for each system."""
    facts = [one for one, _ in known]
    systems, data = system_labels(facts), data_labels(facts)
    columns = list(dict.fromkeys(systems))
    texts = {place: figure_text(row, COMPARED) for place, (_, row) in zip(zip(data, systems), known)}
    longest = {name: max((one for one, other in zip(facts, data) if other == name), key=lambda one: one.frames) for name in data}
    return columns, {name: (longest[name], [texts.get((name, system), NONE) for system in columns]) for name in longest}


def time_table(known: Known, of_paper: bool = True) -> Table | None:
    """Table II: median ms of the stages, by the paper's groups."""
    timings = [(facts, read_json(facts.run.folder / "timing.json")) for facts, _ in known if facts.graph in ("structural", WITH)]
    timed = [(facts, timing) for facts, timing in timings if timing.get("stages")]
    rows = []
    for label, (_, timing) in zip(row_labels([facts for facts, _ in timed]), timed):
        groups = [sum((timing["stages"].get(name) or {}).get("p50_ms") or 0.0 for name in names) for names in STAGE_GROUPS.values()]
        total = (timing.get("frame_ms") or {}).get("p50")
        rows.append((label, *(f"{ms:.1f}" for ms in groups), NONE if total is None else f"{total:.1f}"))
    if not rows:
        return None
    header, note = ("system", *STAGE_GROUPS, "total"), "Median ms: sums of the stages' medians; total is a frame's latency."
    if not of_paper:
        return Table(f"{OTHER}: time per stage", note, header, tuple(rows))
    rows.append(("paper, TUM RGB-D", *(f"{ms:.1f}" for ms in published.paper()["time_ms"]["median"])))
    return Table("Table II: time per stage", f"{note} The paper's machine: {published.paper()['machine']}.", header, tuple(rows))


def refinement_table(known: Known, of_paper: bool = True) -> Table | None:
    """Return the ATE with and without refinement of runs that are alike in all else, and the published one."""
    pairs: dict[tuple[str, str], dict[str, tuple[RunFacts, dict[str, Any]]]] = {}
    for facts, row in known:
        if facts.graph in (WITH, WITHOUT) and COMPARED in row["figures"]:
            alike = " ".join(word for word in row["change"].split() if not word.startswith("graph="))
            pairs.setdefault((row["data"], alike), {})[facts.graph] = (facts, row)
    found = [pair for pair in pairs.values() if set(pair) == {WITH, WITHOUT}]
    with_it = [pair[WITH][0] for pair in found]
    several = len(set(system_labels(with_it))) > 1
    rows = []
    for pair, label in zip(found, row_labels(with_it) if several else data_labels(with_it)):
        with_mm, without_mm = (pair[graph][1]["figures"][COMPARED]["median"] for graph in (WITH, WITHOUT))
        sequence = published.sequence_of(pair[WITH][0].folder_name) or ""
        paper = [published.published_ate_m(sequence, graph) for graph in (WITH, WITHOUT)]
        texts = [NONE if value is None else f"{1e3 * value:g}" for value in paper] if of_paper else []
        rows.append((label, *(figure_text(pair[graph][1], COMPARED) for graph in (WITH, WITHOUT)), f"{without_mm / with_mm:.2f}", *texts))
    header = ("data", "with refinement", "without", "ratio", *(("paper: with", "paper: without") if of_paper else ()))
    return Table("Effect of refinement" if of_paper else f"{OTHER}: effect of refinement", "ATE RMSE in mm.", header, tuple(rows)) if rows else None


def surface_table(known: Known, of_paper: bool = True) -> Table | None:
    """Return error and size of the surfaces that were judged."""
    judged = [(facts, row) for facts, row in known if (facts.run.folder / "surface.ply").is_file() and "surface mm" in row["figures"]]
    rows = []
    for label, (facts, row) in zip(row_labels([facts for facts, _ in judged]), judged):
        size = f"{(facts.run.folder / 'surface.ply').stat().st_size / 1e6:.2f}"
        paper = published.paper()["surface_m"].get(published.sequence_of(facts.folder_name))
        texts = [NONE if paper is None else f"{1e3 * paper[-1]:g}"] if of_paper else []
        rows.append((label, figure_text(row, "surface mm"), figure_text(row, "within 5 cm %"), size, *texts))
    header = ("system", "mean mm", "within 5 cm %", "MB", *(("paper: mean mm",) if of_paper else ()))
    title = "Surface: error and size" if of_paper else f"{OTHER}: surface, error and size"
    note = "Mean distance from the true surface, share of it within 5 cm, size of surface.ply."
    return Table(title, note, header, tuple(rows)) if rows else None


def drift_table(known: Known, of_paper: bool = True) -> Table | None:
    """Return the drift at the end of long walks, in m and % of the path; of walks without ground truth the distance of the end from the start."""
    walks = [(facts, drift) for facts, _ in known if (drift := _drift(facts)) is not None]
    rows = []
    for label, (facts, (drift_m, length_m)) in zip(row_labels([facts for facts, _ in walks]), walks):
        paper = published.paper()["drift_m"].get(published.sequence_of(facts.folder_name))
        texts = ([NONE, NONE] if paper is None else [f"{value:g}" for value in paper]) if of_paper else []
        rows.append((label, f"{length_m:.1f}", f"{drift_m:.4f}", f"{100.0 * drift_m / length_m:.3f}", *texts))
    header = ("system", "path m", "drift m", "% of the path", *(("paper: Ours m", "paper: ORB-SLAM2 m") if of_paper else ()))
    title = "Drift of long walks" if of_paper else f"{OTHER}: drift of long walks"
    return Table(title, f"Walks of at least {LONG_PATH_M:g} m.", header, tuple(rows)) if rows else None


def _drift(facts: RunFacts) -> tuple[float, float] | None:
    """Return the drift of the last pose against the first, and the length of the path, in m; None for a short path or none."""
    folder = facts.run.folder
    try:
        estimate = read_trajectory(folder / "trajectory.txt")
        truth = attached_truth(Recording(folder / "run.mcap").attachments, str(folder))
    except (DataError, RecordingError):
        return None
    poses = estimate.poses
    length_m = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    if length_m < LONG_PATH_M:
        return None
    if truth is None:
        return float(np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3])), length_m
    pairs = associate(estimate.stamps_ns, truth.stamps_ns)
    if len(pairs) < 2:
        return None
    motion, true_motion = (invert(found[ends[0]]) @ found[ends[1]] for found, ends in ((poses, pairs[[0, -1], 0]), (truth.poses, pairs[[0, -1], 1])))
    error_m = float(np.linalg.norm(motion[:3, 3] - true_motion[:3, 3]))
    return (error_m, length_m) if math.isfinite(error_m) else None
