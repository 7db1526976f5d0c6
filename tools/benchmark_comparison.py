"""Comparison of two files of `trihedron benchmark --json`: what became slower.

Times are compared as multiples of each file's own reference workload, so that another machine, or the same one on a slower day, does not count.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.text_table import table

SLOWER = 1.1  # times as long as then; less is the noise of a run
TINY_MS = 0.2  # below which a stage's share of the noise is too large to tell


def times(figures: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """Name -> (p50, p95) in ms: a frame, a frame at the camera's rate if that was measured, and each stage, indented."""
    out = {"frame": (figures["frame_ms"]["p50"], figures["frame_ms"]["p95"])}
    if "paced" in figures:
        out["frame, paced"] = (figures["paced"]["p50"], figures["paced"]["p95"])
    return out | {f"  {name}": (stage["p50_ms"], stage["p95_ms"]) for name, stage in figures["stages"].items()}


def read_figures(path: Path) -> dict[str, Any]:
    """The figures of a file. Raises DataError for one that is not from `trihedron benchmark --json`."""
    try:
        figures: dict[str, Any] = json.loads(path.read_text())
        times(figures), figures["reference_ms"] / figures["fps"]
    except OSError as error:
        raise DataError(str(path), f"cannot be read ({error.strerror})", "give a file written by trihedron benchmark --json") from error
    except (ValueError, KeyError, TypeError, ZeroDivisionError) as error:
        raise DataError(str(path), "holds no figures of a benchmark", "give a file written by trihedron benchmark --json") from error
    return figures


def comparison_table(old: dict[str, Any], new: dict[str, Any]) -> str:
    """A table of then and now, in multiples of the reference, and which became slower by more than a tenth."""
    before, after = _multiples(old), _multiples(new)
    rows: list[tuple[str, ...]] = [("x reference", "then", "now", "change", "")]
    for name in [name for name in after if name in before]:
        ratio = after[name] / before[name] if before[name] > 0.0 else 1.0
        tiny = name.startswith(" ") and after[name] * new["reference_ms"] < TINY_MS
        verdict = "slower" if ratio > SLOWER and not tiny else ""
        rows.append((name, f"{before[name]:.2f}", f"{after[name]:.2f}", f"{100 * (ratio - 1):+.0f} %", verdict))
    rows += [(name, "", f"{after[name]:.2f}", "", "new") for name in after if name not in before]
    rows += [(name, f"{before[name]:.2f}", "", "", "gone") for name in before if name not in after]
    slower = [row[0].strip() for row in rows if row[4] == "slower"]
    return table(rows, "lrrrl") + "\n" + (f"slower: {', '.join(slower)}" if slower else "nothing became slower")


def _multiples(figures: dict[str, Any]) -> dict[str, float]:
    reference = figures["reference_ms"]
    return {"throughput": 1e3 / figures["fps"] / reference} | {name: p50 / reference for name, (p50, _) in times(figures).items()}
