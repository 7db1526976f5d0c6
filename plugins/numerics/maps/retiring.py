"""Keyframes that leave the map, with what only they held up, and the memory that is given back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.table import CHUNK
from trihedron.pipeline.types import I32, Map, Table
from trihedron.plugins.numerics.maps.local_window import observed_by

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
    for kind in KINDS:
        landmarks: Table = getattr(map, f"{kind}s")
        changes[f"{kind}s"] = landmarks.emptied(_unused(landmarks, np.flatnonzero(landmarks.column("alive"))))
        measured: Table = getattr(map, f"{kind}_observations")
        changes[f"{kind}_observations"] = measured.emptied(_unused(measured, _held(map, kind)))
    return replace(map, **changes)


def _held(map: Map, kind: str) -> I32:
    """A row of each chunk of the observation table in which a living keyframe has some."""
    spans = map.keyframes.column(f"{kind}s")[map.keyframes.column("alive")]
    spans = spans[spans[:, 0] < spans[:, 1]]
    chunks = [np.arange(first // CHUNK, (stop - 1) // CHUNK + 1) for first, stop in spans]
    return np.unique(np.concatenate(chunks)).astype(np.int32) * CHUNK if chunks else np.empty(0, np.int32)


def _unused(table: Table, rows: I32) -> I32:
    """Numbers of the full chunks that hold none of the rows."""
    used = np.bincount(rows // CHUNK, minlength=-(-len(table) // CHUNK))
    return np.flatnonzero(used[: len(table) // CHUNK] == 0).astype(np.int32)
