"""Print the paper's own tables over some runs, the published figures beside ours: trajectory error, times, refinement, surface and drift.

Sequences of the paper that are not there are named, with the command that gets them. The runs are those of `experiment=paper`, or any others of the
same graphs. Surfaces that were not judged yet are judged against the ground truth of the scene, where there is one.

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
    options = parser.parse_args(argv)
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
    """Return the paper's tables, filled with the rows of some runs; a table without a row of ours is absent, but for Table I."""
    found = [trajectory_table(known), time_table(known), refinement_table(known), surface_table(known), drift_table(known)]
    return [one for one in found if one is not None]


def trajectory_table(known: Known) -> Table:
    """Table I: ATE RMSE in mm of our systems and the published ones, a row a sequence of the paper."""
    graphs = _graphs(known)
    systems = published.paper()["ate_m"]["systems"]
    rows = []
    for sequence, entry in published.sequences().items():
        if sequence not in published.paper()["ate_m"]:
            continue
        of_it = {facts.graph: (facts, row) for facts, row in known if published.sequence_of(facts.folder_name) == sequence}
        ours = [figure_text(of_it[graph][1], COMPARED) if graph in of_it else NONE for graph in graphs]
        values = [NONE if value is None else f"{1e3 * value:g}" for value in published.paper()["ate_m"][sequence]]
        note = f"trihedron download {entry['download']}"
        if of_it:
            frames = max(facts.frames for facts, _ in of_it.values())
            note = "whole" if frames >= published.WHOLE * entry["frames"] else f"{frames} of about {entry['frames']} frames: not comparable"
        rows.append((sequence, *ours, *values, note))
    header = ("sequence", *graphs, *(f"{name}¹" for name in systems), "frames, or how to get them")
    return Table(
        "Table I: trajectory error",
        "ATE RMSE in mm; - is not there, not published, or lost. ¹ as published. Last column: how to get a sequence that is not there.",
        header,
        tuple(rows),
    )


def time_table(known: Known) -> Table | None:
    """Table II: median ms of the stages, by the paper's groups."""
    rows = []
    for facts, _ in known:
        timing = read_json(facts.run.folder / "timing.json")
        stages = timing.get("stages", {})
        if facts.graph not in ("structural", WITH) or not stages:
            continue
        groups = [sum((stages.get(name) or {}).get("p50_ms") or 0.0 for name in names) for names in STAGE_GROUPS.values()]
        total = (timing.get("frame_ms") or {}).get("p50")
        rows.append((f"{facts.graph}, {_data(facts)}", *(f"{ms:.1f}" for ms in groups), NONE if total is None else f"{total:.1f}"))
    if not rows:
        return None
    median = published.paper()["time_ms"]["median"]
    rows.append(("paper, TUM RGB-D", *(f"{ms:.1f}" for ms in median)))
    note = f"Median ms: sums of the stages' medians; total is a frame's latency. The paper's machine: {published.paper()['machine']}."
    return Table("Table II: time per stage", note, ("system", *STAGE_GROUPS, "total"), tuple(rows))


def refinement_table(known: Known) -> Table | None:
    """Return the ATE with and without refinement, and the published one."""
    by_data: dict[str, dict[str, dict[str, Any]]] = {}
    names: dict[str, RunFacts] = {}
    for facts, row in known:
        if facts.graph in (WITH, WITHOUT):
            by_data.setdefault(row["data"], {})[facts.graph] = row
            names[row["data"]] = facts
    rows = []
    for data, found in by_data.items():
        if set(found) != {WITH, WITHOUT} or any(COMPARED not in row["figures"] for row in found.values()):
            continue
        with_mm, without_mm = (found[graph]["figures"][COMPARED]["median"] for graph in (WITH, WITHOUT))
        sequence = published.sequence_of(names[data].folder_name) or ""
        paper = [published.published_ate_m(sequence, graph) for graph in (WITH, WITHOUT)]
        texts = [NONE if value is None else f"{1e3 * value:g}" for value in paper]
        rows.append((_data(names[data]), *(figure_text(found[graph], COMPARED) for graph in (WITH, WITHOUT)), f"{without_mm / with_mm:.2f}", *texts))
    header = ("data", "with refinement", "without", "ratio", "paper: with", "paper: without")
    return Table("Effect of refinement", "ATE RMSE in mm.", header, tuple(rows)) if rows else None


def surface_table(known: Known) -> Table | None:
    """Return error and size of the surfaces that were judged."""
    rows = []
    for facts, row in known:
        file = facts.run.folder / "surface.ply"
        if file.is_file() and "surface mm" in row["figures"]:
            size = f"{file.stat().st_size / 1e6:.2f}"
            sequence = published.sequence_of(facts.folder_name)
            paper = published.paper()["surface_m"].get(sequence)
            ours = NONE if paper is None else f"{1e3 * paper[-1]:g}"
            rows.append((f"{facts.graph}, {_data(facts)}", figure_text(row, "surface mm"), figure_text(row, "within 5 cm %"), size, ours))
    header = ("system", "mean mm", "within 5 cm %", "MB", "paper: mean mm")
    note = "Mean distance from the true surface, share of it within 5 cm, size of surface.ply."
    return Table("Surface: error and size", note, header, tuple(rows)) if rows else None


def drift_table(known: Known) -> Table | None:
    """Return the drift at the end of long walks, in m and % of the path; of walks without ground truth the distance of the end from the start."""
    rows = []
    for facts, _ in known:
        found = _drift(facts)
        if found is None:
            continue
        drift_m, length_m = found
        sequence = published.sequence_of(facts.folder_name) or ""
        paper = published.paper()["drift_m"].get(sequence)
        texts = [NONE, NONE] if paper is None else [f"{value:g}" for value in paper]
        rows.append((f"{facts.graph}, {_data(facts)}", f"{length_m:.1f}", f"{drift_m:.4f}", f"{100.0 * drift_m / length_m:.3f}", *texts))
    header = ("system", "path m", "drift m", "% of the path", "paper: Ours m", "paper: ORB-SLAM2 m")
    note = (
        f"Walks of at least {LONG_PATH_M:g} m. Where there is none: trihedron run -m graph=structural,structural_paper,points dataset.scene=corridor"
    )
    return Table("Drift of long walks", note, header, tuple(rows)) if rows else None


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


def _graphs(known: Known) -> list[str]:
    """Return the graphs of runs on sequences of the paper; of all runs where there is none."""
    there = [facts.graph for facts, _ in known if published.sequence_of(facts.folder_name)]
    return list(dict.fromkeys(there or [facts.graph for facts, _ in known]))


def _data(facts: RunFacts) -> str:
    """Return a short name of a run's data: its folder, else the words of the data set without its name, seed and length."""
    skipped = ("dataset", "dataset.seed", "dataset.length", "dataset.frames")
    words = [
        f"{key.removeprefix('dataset.')}={value}" for key, value in facts.run.overrides.items() if key.startswith("dataset") and key not in skipped
    ]
    return facts.folder_name or " ".join(["room", *words])
