"""Numba kernels of `planar_greedy.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32

# Greedy triangulation of points in a plane: the shortest edges first, each that crosses none before it (after Marton, Rusu, Beetz, ICRA 2009).

MOST = 96  # neighbours of a point that may be joined to it


@kernel
def accept_edges(points: F64, edges: I32, length: F64, distance: F64, nearest: I32) -> I32:
    """Rows of the edges, shortest first, that cross no edge accepted before. One that does is no longer, so one of its ends is as near to an end of
    the edge as that is long: among its neighbours (n, MOST), sorted by distance."""
    partners = np.full((len(points), MOST), -1, np.int32)
    degree = np.zeros(len(points), np.int32)
    out, count, last = np.empty(len(edges), np.int32), 0, distance.shape[1] - 1
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        free = degree[a] < MOST and degree[b] < MOST
        for end in (a, b):
            if last == MOST - 1 and distance[end, last] < length[e]:
                free = False  # more neighbours than are known
            for k in range(last + 1):
                if not free or distance[end, k] > length[e]:
                    break
                free = not _any_crosses(points, a, b, nearest[end, k], partners, degree)
        if free:
            partners[a, degree[a]], partners[b, degree[b]] = b, a
            degree[a] += 1
            degree[b] += 1
            out[count] = e
            count += 1
    return out[:count].copy()


@kernel
def _any_crosses(points: F64, a: int, b: int, c: int, partners: I32, degree: I32) -> bool:
    """Return True if an accepted edge from c crosses ab."""
    for k in range(degree[c]):
        d = partners[c, k]
        if c != a and c != b and d != a and d != b and _crosses(points[a], points[b], points[c], points[d]):
            return True
    return False


@kernel(inline="always")
def _turn(a: F64, b: F64, c: F64) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


@kernel(inline="always")
def _crosses(a: F64, b: F64, c: F64, d: F64) -> bool:
    """Return True if segments ab and cd cross or touch."""
    return _turn(a, b, c) * _turn(a, b, d) <= 0.0 and _turn(c, d, a) * _turn(c, d, b) <= 0.0
