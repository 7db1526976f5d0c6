"""Tables of `experiment=methods`: each slot's plugins in the default graph over every sequence, and the systems.

A cell is the ATE in mm, with the share of the frames that were tracked where it is not all, or where a sequence has no truth. NEES is the median over
the sequences of the poses' normalised squared errors (1 where the covariance is right), ms those of the stage itself (of the whole frame for a
system), MB the largest peak of memory. With --json the figures are written for the pages of the plugins.

Example: trihedron benchmark methods runs/methods --detectors detectors.json --json docs/results/methods.json
"""

from __future__ import annotations

import json
import statistics
from pathlib import Path
from typing import Any

import yaml

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.run.results import METRICS, TIMING
from trihedron.tools.arguments import Parser, table
from trihedron.tools.compare import run_folders

DEFAULT = "default"  # the change of a run that changes nothing
CHI2_6_MEDIAN = 5.348
Row = dict[str, Any]


def main(argv: list[str]) -> int:
    """Print the tables; returns the exit code, 1 when a job failed. Raises DataError when there are no runs."""
    parser = Parser("benchmark methods", __name__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="of sweeps by experiment=methods")
    parser.add_argument("--detectors", type=Path, metavar="FILE", help="of: trihedron benchmark detectors --json FILE; goes to --json too")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures")
    options = parser.parse_args(argv)
    rows = [row_of(run) for folder in options.folders for run in run_folders(folder)]
    print(report(rows))
    if options.json:
        detectors = json.loads(options.detectors.read_text()) if options.detectors else {}
        options.json.parent.mkdir(parents=True, exist_ok=True)
        lines = ",\n".join(json.dumps(row) for row in rows)
        options.json.write_text(f'{{"detectors": {json.dumps(detectors)},\n"runs": [\n{lines}\n]}}\n')
    return 1 if any(row["note"] for row in rows) else 0


def row_of(folder: Path) -> Row:
    """The figures of a run. Raises DataError when its files cannot be read."""
    try:
        words = yaml.safe_load((folder / ".hydra" / "overrides.yaml").read_text()) or []
        metrics, timing, job = (_read(folder / name) for name in (METRICS, TIMING, "job.json"))
    except (OSError, ValueError) as error:
        raise DataError(str(folder), f"cannot be read: {error}", "run it again") from error
    overrides = dict(word.split("=", 1) for word in words if "=" in word)
    change = " ".join(f"{key}={value}" for key, value in overrides.items() if key in (*SLOTS, "graph", "without") and key != "dataset") or DEFAULT
    final, status = metrics.get("final", {}), metrics.get("status", {})
    tracked = sum(status.get(name, 0) for name in ("ok", "degraded")) / max(metrics.get("frames", 0), 1)
    stage = timing.get("stages", {}).get(change.partition("=")[0], {})
    done = job.get("state", "done") == "done" and metrics
    return {
        "change": change,
        "sequence": sequence_of(overrides),
        "ate_mm": _rounded(1e3 * final["ate_rmse_m"] if "ate_rmse_m" in final else None),
        "tracked": _rounded(tracked if metrics else None),
        "nees": _rounded(nees_of(metrics)),
        "ms": _rounded(stage.get("p50_ms")),
        "frame_ms": _rounded(timing.get("frame_ms", {}).get("p50")),
        "mb": _rounded(timing.get("peak_memory_mb")),
        "note": "" if done else str(job.get("error") or "was stopped before its end"),
    }


def sequence_of(overrides: dict[str, str]) -> str:
    """A short name of the data: the folder, or the options of a synthetic scene."""
    if path := overrides.get("dataset.path"):
        return Path(path).name
    options = {key.removeprefix("dataset."): value for key, value in overrides.items() if key.startswith("dataset.") and key != "dataset.length"}
    return " ".join(["room", *(f"{key}={value}" for key, value in options.items())])


def nees_of(metrics: Row) -> float | None:
    """The median NEES of the poses over that of χ² with six degrees of freedom, where there is a truth."""
    found = metrics.get("consistency", {}).get("nees_median")
    return float(found) / CHI2_6_MEDIAN if found is not None else None


def report(rows: list[Row]) -> str:
    """A table for each slot, and one of the systems."""
    sequences = list(dict.fromkeys(row["sequence"] for row in rows))
    groups: dict[str, list[str]] = {}
    for row in rows:
        groups.setdefault(_group(row["change"]), []).append(row["change"])
    default = groups.pop(DEFAULT, [])
    texts = []
    for group, changes in groups.items():
        header = [group, *sequences, "NEES", "ms", "MB"]
        lines = [[change, *_cells([row for row in rows if row["change"] == change], sequences)] for change in dict.fromkeys([*default, *changes])]
        texts.append(table([header, *lines], right="l" + "r" * (len(sequences) + 3)))
    failed = [f"{row['change']}, {row['sequence']}: {row['note']}" for row in rows if row["note"]]
    return "\n\n".join([*texts, *failed, f"{len(rows)} runs, {len(failed)} failed"])


def _group(change: str) -> str:
    return change.partition("=")[0]


def _cells(rows: list[Row], sequences: list[str]) -> list[str]:
    by = {row["sequence"]: row for row in rows}
    whole = rows[0]["change"].startswith(("graph=", "without=", DEFAULT)) if rows else True
    values = [[row[key] for row in rows if row[key] is not None] for key in ("nees", "frame_ms" if whole else "ms", "mb")]
    medians = [f"{statistics.median(found):.{digits}f}" if found else "-" for found, digits in zip(values[:2], (2, 1))]
    return [*(cell_of(by.get(name)) for name in sequences), *medians, f"{max(values[2]):.0f}" if values[2] else "-"]


def cell_of(row: Row | None) -> str:
    """ATE in mm, and the share tracked where it says something."""
    if row is None:
        return ""
    if row["note"]:
        return "failed"
    share = f"{100.0 * row['tracked']:.0f} %"
    if row["ate_mm"] is None:
        return share
    return f"{row['ate_mm']:.1f}" + ("" if row["tracked"] > 0.999 else f" ({share})")


def _read(file: Path) -> Row:
    found: Row = json.loads(file.read_text()) if file.exists() else {}
    return found


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")
