"""Published figures of the paper, and those of other programs on the same frames (published.yaml)."""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files
from typing import Any

import yaml

LEAST_SHARE = 0.95  # of a sequence's frames; a reader skips those whose images are broken or repeated
WHOLE = 0.9  # of a sequence's frames; with fewer the published figure is of something else


@cache
def _content() -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load(files(__package__).joinpath("published.yaml").read_text("utf-8"))
    return found


def paper() -> dict[str, Any]:
    """Return the paper's tables: `ate_m`, `time_ms`, `surface_m`, `drift_m`, and `systems`, our graph -> the column of Table I."""
    found: dict[str, Any] = _content()["paper"]
    return found


def peers() -> dict[str, Any]:
    """Return the figures of other programs: `programs`, name -> cell -> figures, and `sequences`, cell -> folder and frames."""
    found: dict[str, Any] = _content()["peers"]
    return found


def sequences() -> dict[str, dict[str, Any]]:
    """Return the paper's sequences: name -> `frames` of the whole, `folder` (regular expression) and `download`."""
    found: dict[str, dict[str, Any]] = _content()["sequences"]
    return found


def sequence_of(folder: str) -> str | None:
    """Return the paper's sequence that a folder of this name holds, or None."""
    return next((name for name, entry in sequences().items() if re.search(entry["folder"], folder)), None)


def published_ate_m(sequence: str, graph: str) -> float | None:
    """Return Table I's figure for a sequence and a graph of ours; None where there is none, or the published system was lost."""
    column, row = paper()["systems"].get(graph), paper()["ate_m"].get(sequence)
    value = None if column is None or row is None else row[paper()["ate_m"]["systems"].index(column)]
    return None if value is None else float(value)


def peer_figures(folder: str, frames: int) -> dict[str, dict[str, Any]]:
    """Return the figures of other programs on the frames of which `frames` were read, by program; empty where they ran on others."""
    entries = {name: entry for name, entry in peers()["sequences"].items() if re.search(entry["folder"], folder)}
    cells = [name for name, entry in entries.items() if LEAST_SHARE * entry["frames"] <= frames <= entry["frames"]]
    return {program: found[cell] for program, found in peers()["programs"].items() for cell in cells if cell in found}
