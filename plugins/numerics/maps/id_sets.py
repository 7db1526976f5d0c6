"""Sets of ids, as sorted rows. Ids lie close together, so marking them beats sorting them."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import I32, Bool


def distinct(ids: I32) -> I32:
    """(n,) the different ids, sorted."""
    if len(ids) == 0:
        return ids
    first = ids.min()
    marked = np.zeros(ids.max() - first + 1, np.bool_)
    marked[ids - first] = True
    return (np.flatnonzero(marked) + first).astype(np.int32)


def union(a: I32, b: I32) -> I32:
    """(n,) the ids of both, once each and sorted."""
    marked = np.zeros(_end(a, b), np.bool_)
    marked[a] = True
    marked[b] = True
    return np.flatnonzero(marked).astype(np.int32)


def among(ids: I32, others: I32) -> Bool:
    """(n,) which of the ids are among the others."""
    marked = np.zeros(_end(ids, others), np.bool_)
    marked[others] = True
    found: Bool = marked[ids]
    return found


def places(ids: I32, others: I32) -> I32:
    """(n,) the row of each id among the others, which are sorted, -1 where it is none of them."""
    if not len(others):
        return np.full(len(ids), -1, np.int32)
    first = others[0] - 1
    rows = np.full(others[-1] - first + 2, -1, np.int32)
    rows[others - first] = np.arange(len(others), dtype=np.int32)
    return np.asarray(rows[np.clip(ids - first, 0, len(rows) - 1)], np.int32)


def _end(*parts: I32) -> int:
    return max((int(part.max()) + 1 for part in parts if len(part)), default=0)
