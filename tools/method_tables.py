"""Tables of `experiment=methods`: each slot's plugins in the default graph over every sequence, and the systems.

A cell is the ATE in mm, with the share of the frames that were tracked where it is not all, or where a sequence has no truth. NEES is the median over
the sequences of `nees_median` of metrics.json (5.35 where covariances are right), ms those of the stage itself (of the whole frame for a system), MB
the most memory that a run took for itself (`own_memory_mb` of timing.json, without the program and its libraries).

Columns behind MB are the slot's own measures, means over the sequences that have them: those of `trihedron ablate` in the open loop, on the recording
of the unchanged graph, of which refinement against the map hides nothing; of surfaces and buildings, errors against the true ones. They are computed
where they are missing, and kept in FOLDER/open_loop. With --json all figures are written for the pages of the plugins.

Example: trihedron benchmark methods runs/methods --detectors detectors.json --json docs/results/methods.json
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

from trihedron.comparison.attribution import nees_of
from trihedron.comparison.fold_measures import Measures
from trihedron.comparison.runs import judge_surfaces, run_folders
from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.text_table import table
from trihedron.pipeline.run.result_files import read_results, read_words
from trihedron.pipeline.run.results import METRICS, TIMING
from trihedron.pipeline.sweep.sweep import GRAPH_KEYS, is_graph_word
from trihedron.tools import own_measures
from trihedron.tools.arguments import Parser

DEFAULT = "default"  # the change of a run that changes nothing
Row = dict[str, Any]
Runs = list[tuple[Path, Row]]  # folder and figures of each run


def main(argv: list[str]) -> int:
    """Print the tables; returns the exit code, 1 when a job failed. Raises DataError when there are no runs."""
    parser = Parser("benchmark methods", __name__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="of sweeps by experiment=methods")
    parser.add_argument("--detectors", type=Path, metavar="FILE", help="of: trihedron benchmark detectors --json FILE; goes to --json too")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    options = parser.parse(argv)
    rows, failures = [], []
    judge_surfaces(options.folders)
    for folder in options.folders:
        runs = [(run, row_of(run)) for run in run_folders(folder)]
        failures += add_measures(runs, folder / own_measures.FOLDER)
        rows += [row for _, row in runs]
    print("\n".join([report(rows), *failures]))
    if options.json:
        detectors = json.loads(options.detectors.read_text()) if options.detectors else {}
        options.json.parent.mkdir(parents=True, exist_ok=True)
        lines = ",\n".join(json.dumps(row) for row in rows)
        write_file(options.json, f'{{"detectors": {json.dumps(detectors)},\n"runs": [\n{lines}\n]}}\n')
    return 1 if failures or any(row["note"] for row in rows) else 0


def row_of(folder: Path) -> Row:
    """The figures of a run. Raises DataError when its files cannot be read."""
    words = read_words(folder / ".hydra" / "overrides.yaml")
    metrics, timing, job = (read_results(folder / name) for name in (METRICS, TIMING, "job.json"))
    of_data = list(takewhile(lambda word: word.lstrip("+").startswith("dataset") or is_graph_word(word), words))
    changes = [word for word in words[len(of_data) :] if word.partition("=")[0] in GRAPH_KEYS]
    change = " ".join(changes) or DEFAULT
    final, status = metrics.get("final") or {}, metrics.get("status") or {}
    tracked = sum(status.get(name) or 0 for name in ("ok", "degraded")) / max(metrics.get("frames") or 0, 1)
    stage = timing.get("stages", {}).get(change.partition("=")[0], {})
    done = job.get("state", "done") == "done" and metrics
    return {
        "change": change,
        "sequence": sequence_of([*of_data, *(word for word in words[len(of_data) :] if word.startswith("dataset."))]),
        "ate_mm": _round_value(1e3 * final["ate_rmse_m"] if "ate_rmse_m" in final else None),
        "tracked": _round_value(tracked if metrics else None),
        "nees": _round_value(nees_of(metrics)),
        "ms": _round_value(stage.get("p50_ms")),
        "frame_ms": _round_value(timing.get("frame_ms", {}).get("p50")),
        "mb": _round_value(timing.get("own_memory_mb")),
        "note": "" if done else str(job.get("error") or "was stopped before its end"),
        "measures": {},
    }


def sequence_of(words: Sequence[str]) -> str:
    """Return a short name of the data: the folder, or the options of a synthetic scene; and the words of the graph that it is of."""
    values = dict(word.lstrip("+").split("=", 1) for word in words)
    of_graph = [word for word in words if is_graph_word(word)]
    if path := values.get("dataset.path"):
        return " ".join([Path(path).name, *of_graph])
    kind, scene = values.get("dataset", "synthetic"), values.get("dataset.scene", "room")
    options = {key.removeprefix("dataset."): value for key, value in values.items() if key.startswith("dataset.")}
    texts = [f"{key}={value}".replace("\\:", ":") for key, value in options.items() if key != "scene" and not key.endswith("length")]
    return " ".join([scene if kind == "synthetic" else kind, *texts, *of_graph])


def add_measures(runs: Runs, folder: Path) -> list[str]:
    """Add the slots' own measures to the rows of a sweep's runs; what the open loop computes goes to the folder. Returns why some have none."""
    failures = []
    for run, row in runs:
        if (measure := own_measures.OF_FOLDS.get(_group(row["change"]))) and not row["note"]:
            row["measures"] = _rounded_all(measure(run))
    for run, base in runs:
        if base["change"] != DEFAULT or base["note"]:
            continue
        of_sequence = [row for _, row in runs if row["sequence"] == base["sequence"] and not row["note"]]
        for slot in own_measures.MEASURED:
            rows = {row["change"].partition("=")[2]: row for row in of_sequence if _group(row["change"]) == slot and " " not in row["change"]}
            try:
                found = own_measures.open_loop(run, slot, list(rows), folder / run.name / slot) if rows else {}
            except TrihedronError as error:
                failures.append(f"open loop of {slot}, {base['sequence']}: {error}")
                continue
            base["measures"] |= _rounded_all(found.get("", {}))
            for name, row in rows.items():
                row["measures"] = _rounded_all(found.get(name, found.get("", {})))
    return failures


def _rounded_all(measures: Measures) -> dict[str, float | None]:
    return {name: _round_value(value) for name, value in measures.items()}


def report(rows: list[Row]) -> str:
    """A table for each slot, and one of the systems."""
    sequences = list(dict.fromkeys(row["sequence"] for row in rows))
    groups: dict[str, list[str]] = {}
    for row in rows:
        groups.setdefault(_group(row["change"]), []).append(row["change"])
    default = groups.pop(DEFAULT, [])
    texts = []
    for group, changes in groups.items():
        own = [row for row in rows if _group(row["change"]) == group]
        places = [name for name in sequences if any(row["sequence"] == name for row in own)]
        columns = [name for name in own_measures.DECIMALS if any(name in row["measures"] for row in own)]
        header = [group, *(f"ATE {sequences.index(name) + 1}" for name in places), "NEES", "ms", "MB", *columns]
        lines = []
        for change in dict.fromkeys([*default, *changes]):
            some = [row for row in rows if row["change"] == change and row["sequence"] in places]
            lines.append([change, *_cells(some, places), *(_mean_of(some, name) for name in columns)])
        texts.append(table([header, *lines], right="l" + "r" * (len(header) - 1)))
    failed = [f"{row['change']}, {row['sequence']}: {row['note']}" for row in rows if row["note"]]
    legend = "\n".join(f"ATE {number}: {name}" for number, name in enumerate(sequences, 1))
    return "\n\n".join([*texts, legend, *failed, f"{len(rows)} runs, {len(failed)} failed"])


def _group(change: str) -> str:
    return change.partition("=")[0]


def _cells(rows: list[Row], sequences: list[str]) -> list[str]:
    by = {row["sequence"]: row for row in rows}
    whole = rows[0]["change"].startswith(("graph=", "without=", DEFAULT)) if rows else True
    values = [[row[key] for row in rows if row[key] is not None] for key in ("nees", "frame_ms" if whole else "ms", "mb")]
    medians = [f"{statistics.median(found):.{digits}f}" if found else "-" for found, digits in zip(values[:2], (2, 1))]
    return [*(cell_of(by.get(name)) for name in sequences), *medians, f"{max(values[2]):.0f}" if values[2] else "-"]


def _mean_of(rows: list[Row], name: str) -> str:
    values = [row["measures"][name] for row in rows if name in row["measures"]]
    return f"{statistics.mean(values):.{own_measures.DECIMALS[name]}f}" if values else "-"


def cell_of(row: Row | None) -> str:
    """ATE in mm, and the share tracked where it is not all."""
    if row is None:
        return ""
    if row["note"]:
        return "failed"
    share = f"{100.0 * row['tracked']:.0f} %"
    if row["ate_mm"] is None:
        return share
    return f"{row['ate_mm']:.1f}" + ("" if row["tracked"] > 0.999 else f" ({share})")


def _round_value(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")
