"""What neighbours what in a triangle mesh. Half-edge 3 t + k runs from corner k of triangle t to the next one."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F64, I32

OPEN = -1  # beyond a half-edge: nothing, or more than one triangle


def opposite_half_edges(triangles: I32) -> I32:
    """(3 t,) the half-edge that runs the other way along the same edge; OPEN where there is none, or the edge has more than two triangles."""
    begin, end = triangles.ravel().astype(np.int64), triangles[:, [1, 2, 0]].ravel().astype(np.int64)
    size = int(triangles.max()) + 1 if len(triangles) else 1
    low, high = np.minimum(begin, end), np.maximum(begin, end)
    order = np.argsort(low * size + high, kind="stable")
    return _paired(order, (low * size + high)[order], begin)


@numba.njit(cache=True, nogil=True)
def _paired(order: I32, keys: I32, begin: I32) -> I32:
    out = np.full(len(order), OPEN, np.int32)
    i = 0
    while i < len(order):
        j = i + 1
        while j < len(order) and keys[j] == keys[i]:
            j += 1
        if j - i == 2 and begin[order[i]] != begin[order[i + 1]]:
            out[order[i]], out[order[i + 1]] = order[i + 1], order[i]
        i = j
    return out


@numba.njit(cache=True, nogil=True)
def connected(opposite: I32, labels: I32) -> tuple[I32, int]:
    """(t,) numbers of the connected sets of triangles of equal label, from 0 in the order of their first triangle, and their count."""
    n = len(labels)
    parts, stack, count = np.full(n, -1, np.int32), np.empty(n, np.int32), 0
    for seed in range(n):
        if parts[seed] >= 0:
            continue
        parts[seed], stack[0], top = count, seed, 1
        while top:
            top -= 1
            t = stack[top]
            for k in range(3):
                other = opposite[3 * t + k]
                if other >= 0 and parts[other // 3] < 0 and labels[other // 3] == labels[seed]:
                    parts[other // 3] = count
                    stack[top] = other // 3
                    top += 1
        count += 1
    return parts, count


def with_single_fans(vertices: F64, triangles: I32) -> tuple[F64, I32]:
    """The mesh with a vertex of its own for each fan of triangles: none is shared by sheets that touch in a point alone."""
    fans = _fans(opposite_half_edges(triangles))
    corners = triangles.ravel()
    _, first, number = np.unique(fans, return_index=True, return_inverse=True)
    return vertices[corners[first]], number.reshape(-1, 3).astype(np.int32)


@numba.njit(cache=True, nogil=True)
def _join(root: I32, a: int, b: int) -> None:
    while root[a] != a:
        root[a] = root[root[a]]
        a = root[a]
    while root[b] != b:
        root[b] = root[root[b]]
        b = root[b]
    root[max(a, b)] = min(a, b)


@numba.njit(cache=True, nogil=True)
def _fans(opposite: I32) -> I32:
    """(3 t,) the least corner of the fan that each corner belongs to: corners at the two ends of an edge are those of the triangle beyond it."""
    root = np.arange(len(opposite), dtype=np.int32)
    for h in range(len(opposite)):
        o = opposite[h]
        if o > h:
            _join(root, h, o - o % 3 + (o % 3 + 1) % 3)
            _join(root, h - h % 3 + (h % 3 + 1) % 3, o)
    for c in range(len(root)):
        while root[root[c]] != root[c]:
            root[c] = root[root[c]]
    return root


def triangle_areas(vertices: F64, triangles: I32) -> F64:
    """(t,) areas in m²."""
    corners = vertices[triangles]
    return np.asarray(0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1), np.float64)


def without_crumbs(vertices: F64, triangles: I32, least_m2: float) -> I32:
    """The triangles (n, 3) of those connected sets that have at least that area."""
    parts, count = connected(opposite_half_edges(triangles), np.zeros(len(triangles), np.int32))
    return triangles[np.bincount(parts, triangle_areas(vertices, triangles), count)[parts] >= least_m2]


def compacted(vertices: F64, triangles: I32) -> tuple[F64, I32, I32]:
    """The mesh without the vertices that no triangle uses, and the new numbers of the old vertices (v,)."""
    used = np.zeros(len(vertices), np.bool_)
    used[triangles] = True
    renamed = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return vertices[used], renamed[triangles], renamed
