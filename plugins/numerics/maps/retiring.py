"""Keyframes that leave the map, with what only they held up, and the memory that is given back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.types import Map, Table
from trihedron.plugins.numerics.maps.local_window import living_keyframes, observed_by

KINDS = ("point", "line", "plane")


def retired(map: Map, keyframe: int) -> Map:
    """The map without a keyframe in any window. Its row stays, for the poses that hang on it; its measurements are given up. Landmarks forget it,
    and points and lines that no other one remembers die: nothing would look for them any more. Planes stay, for the surface."""
    row = np.array([keyframe], np.int32)
    changes: dict[str, Any] = {}
    for kind in KINDS:
        ids, table = observed_by(map, row, kind), getattr(map, f"{kind}s")
        observers = table.rows("observers", ids)
        observers = -np.sort(-np.where(observers == keyframe, -1, observers), axis=1)  # newest first, as before
        table = table.updated(ids, observers=observers)
        alone = ids[observers[:, 0] < 0] if kind != "plane" else ids[:0]
        changes[f"{kind}s"] = table.updated(alone, alive=np.zeros(len(alone), np.bool_))
    nothing = {f"{kind}s": np.zeros((1, 2), np.int32) for kind in KINDS}
    return replace(map, keyframes=map.keyframes.updated(row, alive=np.zeros(1, np.bool_), **nothing), **changes)


def released(map: Map) -> Map:
    """The same map with the chunks given back in which no landmark lives, or no living keyframe has a measurement; rows keep their numbers."""
    changes: dict[str, Table] = {}
    held = living_keyframes(map)
    for kind in KINDS:
        landmarks, measured = getattr(map, f"{kind}s"), getattr(map, f"{kind}_observations")
        ids = np.flatnonzero(landmarks.column("alive"))
        changes[f"{kind}s"] = landmarks.keeping(np.stack([ids, ids + 1], axis=1))
        changes[f"{kind}_observations"] = measured.keeping(map.keyframes.rows(f"{kind}s", held))
    return replace(map, **changes)
