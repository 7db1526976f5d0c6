"""The runs of sweeps as one table: what each one changed, what it tracked, its errors and its time.

A row is what a run's overrides say that those of the others do not; runs that differ in their seed alone share a row, as mean and standard deviation.
Rows of one data set stand together, and `x first` compares a row's ATE with the first of them. `trihedron run -m experiment=leave_one_out` ends with
this; several folders make one table.

Example: trihedron benchmark runs runs/without --json table.json
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from trihedron.pipeline.errors import DataError
from trihedron.tools.arguments import Parser, table

SEEDS = ("seed", "dataset.seed")
NOT_SHOWN = ("out", "report", "experiment", *SEEDS)
FIGURES = {  # name of a column -> where it is in metrics.json (final.…) or timing.json, factor, decimals
    "tracked %": ("tracked_share", 100.0, 1),
    "ATE mm": ("ate_rmse_m", 1e3, 2),
    "RPE 1 s mm": ("rpe_second_rmse_m", 1e3, 2),
    "RPE 1 s deg": ("rpe_second_rmse_deg", 1.0, 3),
    "frame p50 ms": ("p50_ms", 1.0, 1),
}


@dataclass(frozen=True)
class Run:
    """One run: its overrides (key -> value), and its figures by column, NaN where there is none."""

    overrides: dict[str, str]
    figures: dict[str, float]


def main(argv: list[str]) -> int:
    """Print the table; returns the exit code. Raises DataError when there are no runs."""
    parser = Parser("benchmark runs", __name__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="of sweeps, or of single runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows too")
    options = parser.parse_args(argv)
    rows = rows_of([run for folder in options.folders for run in read_runs(folder)])
    print(as_text(rows))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")
    return 0


def read_runs(folder: Path) -> list[Run]:
    """The runs in a folder, itself or the jobs of a sweep, by job number. Raises DataError when it holds none."""
    files = [*folder.glob(".hydra/overrides.yaml"), *folder.glob("*/.hydra/overrides.yaml")]
    if not files:
        raise DataError(str(folder), "holds no runs", "give the out=FOLDER of a sweep, for example of: trihedron run -m experiment=leave_one_out")
    return [_run(file.parent.parent) for file in sorted(files, key=lambda f: (len(str(f)), str(f)))]


def _run(folder: Path) -> Run:
    overrides = dict(text.lstrip("+~").partition("=")[::2] for text in yaml.safe_load((folder / ".hydra" / "overrides.yaml").read_text()))
    final: dict[str, Any] = _read(folder / "metrics.json").get("final") or {}
    figures = {**final, "p50_ms": _read(folder / "timing.json").get("frame_ms", {}).get("p50")}
    known = {key: value for key, value in figures.items() if value is not None}  # too short a run has no RPE over a second
    return Run(overrides, {column: factor * known.get(key, np.nan) for column, (key, factor, _) in FIGURES.items()})


def _read(file: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    return found


def rows_of(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """One row for each data set and change: `data`, `change`, `runs`, and each figure's mean and standard deviation over its runs."""
    keys = {key for run in runs for key in run.overrides if key not in NOT_SHOWN}
    varying = sorted(key for key in keys if len({run.overrides.get(key) for run in runs}) > 1)
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((_said(run, [k for k in varying if _of_data(k)]), _said(run, [k for k in varying if not _of_data(k)])), []).append(run)
    order = list(dict.fromkeys(data for data, _ in groups))
    rows: list[dict[str, Any]] = []
    for (data, change), same in sorted(groups.items(), key=lambda group: order.index(group[0][0])):
        figures = {column: [run.figures[column] for run in same] for column in FIGURES}
        spread = {column: {"mean": float(np.mean(values)), "std": float(np.std(values))} for column, values in figures.items()}
        rows.append({"data": data, "change": change, "runs": len(same), **spread})
    return rows


def _of_data(key: str) -> bool:
    return key.partition(".")[0] == "dataset"


def _said(run: Run, keys: Sequence[str]) -> str:
    """What a run's overrides say of these keys; of a path its last part."""
    return " ".join(f"{key}={Path(run.overrides[key]).name}" for key in keys if run.overrides.get(key, "null") != "null")


def as_text(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a table."""
    several = len({row["data"] for row in rows}) > 1
    out = [[*(["data"] if several else []), "change", "runs", *FIGURES, "x first"]]
    first: dict[str, float] = {}
    for row in rows:
        ate = row["ATE mm"]["mean"]
        ratio = ate / first.setdefault(row["data"], ate)
        cells = [_cell(row[column], row["runs"], decimals) for column, (_, _, decimals) in FIGURES.items()]
        shown = f"{ratio:.2f}" if np.isfinite(ratio) else "-"
        out.append([*([row["data"] or "-"] if several else []), row["change"] or "-", row["runs"], *cells, shown])
    return table(out, ("ll" if several else "l") + "r" * (2 + len(FIGURES)))


def _cell(figure: dict[str, float], runs: int, decimals: int) -> str:
    if not np.isfinite(figure["mean"]):
        return "-"
    return f"{figure['mean']:.{decimals}f}" + (f" ±{figure['std']:.{decimals}f}" if runs > 1 else "")
