"""Removing landmarks that are not found again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.types import Map, Matches, Table
from trihedron.plugins.numerics.local_window import observed_by


def cull(map: Map, keyframe: int, matches: Matches | None, trial: int, min_found: float) -> Map:
    """Kill points and lines that were expected by this keyframe, or born `trial` keyframes ago, and are found too seldom. Costs what is in view,
    not what is in the map."""
    young = np.array([keyframe - trial], np.int32) if keyframe >= trial else np.empty(0, np.int32)
    changes: dict[str, Any] = {}
    for kind, visible in (("point", "visible_points"), ("line", "visible_lines")):
        table: Table = getattr(map, f"{kind}s")
        ids = np.union1d(observed_by(map, young, kind), getattr(matches, visible) if matches is not None else young[:0]).astype(np.int32)
        found, seen, first = table.rows("found", ids), table.rows("visible", ids), table.rows("first", ids)
        seldom = (found < min_found * seen) | ((first == keyframe - trial) & (found < trial) & (seen >= trial))
        ids = ids[seldom]
        changes[f"{kind}s"] = table.updated(ids, alive=np.zeros(len(ids), np.bool_))
    return replace(map, **changes)
