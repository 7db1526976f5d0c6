"""What neighbours what in a triangle mesh. Half-edge 3 t + k runs from corner k of triangle t to the next one."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32

OPEN = -1  # beyond a half-edge: nothing, or more than one triangle


def opposite_half_edges(triangles: I32) -> I32:
    """(3 t,) the half-edge that runs the other way along the same edge; OPEN where there is none, or the edge has more than two triangles."""
    return _paired(triangles, int(triangles.max()) + 1 if len(triangles) else 0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _paired(triangles: I32, count: int) -> I32:
    """Half-edges sorted by the lower of their vertices, then compared with those of the same."""
    size = 3 * len(triangles)
    starts, high = np.zeros(count + 1, np.int32), np.empty(size, np.int32)
    for h in range(size):
        a, b = triangles[h // 3, h % 3], triangles[h // 3, (h + 1) % 3]
        starts[min(a, b) + 1] += 1
        high[h] = max(a, b)
    for v in range(count):
        starts[v + 1] += starts[v]
    order, filled = np.empty(size, np.int32), starts[:-1].copy()
    for h in range(size):
        v = min(triangles[h // 3, h % 3], triangles[h // 3, (h + 1) % 3])
        order[filled[v]] = h
        filled[v] += 1
    out = np.full(size, OPEN, np.int32)
    for v in range(count):
        for i in range(starts[v], starts[v + 1]):
            h, other, found = order[i], OPEN, 0
            for j in range(starts[v], starts[v + 1]):
                if j != i and high[order[j]] == high[h]:
                    other, found = order[j], found + 1
            if found == 1 and triangles[other // 3, other % 3] != triangles[h // 3, h % 3]:
                out[h] = other
    return out


def crowded(triangles: I32, opposite: I32) -> I32:
    """The half-edges (n,) along edges with more than two triangles, or with two that run along it the same way."""
    alone = np.flatnonzero(opposite < 0)
    ends = np.sort(np.stack([triangles.ravel()[alone], triangles[:, [1, 2, 0]].ravel()[alone]], axis=1), axis=1)
    _, edge, times = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(alone[times[edge.ravel()] > 1], np.int32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
    first = fans == np.arange(len(fans))
    number = np.cumsum(first, dtype=np.int32) - np.int32(1)
    return vertices[triangles.ravel()[first]], number[fans].reshape(-1, 3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _join(root: I32, a: int, b: int) -> None:
    while root[a] != a:
        root[a] = root[root[a]]
        a = root[a]
    while root[b] != b:
        root[b] = root[root[b]]
        b = root[b]
    root[max(a, b)] = min(a, b)


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def triangle_normals(vertices: F64, triangles: I32) -> F64:
    """(t, 3) normals, as long as twice the area."""
    out = np.empty((len(triangles), 3))
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x1, y1, z1 = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        x2, y2, z2 = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        out[t, 0], out[t, 1], out[t, 2] = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
    return out


def triangle_areas(vertices: F64, triangles: I32) -> F64:
    """(t,) areas in m²."""
    return np.asarray(0.5 * np.sqrt((triangle_normals(vertices, triangles) ** 2).sum(axis=1)), np.float64)


def vertex_normals(vertices: F64, triangles: I32) -> F64:
    """(v, 3) unit normals, the mean of those of the triangles (t, 3) about a vertex weighed by their areas; zero where there is none."""
    total = np.zeros_like(vertices)
    _gather(triangle_normals(vertices, triangles), triangles, total)
    return total / np.maximum(np.sqrt((total**2).sum(axis=1)), 1e-12)[:, None]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather(normals: F64, triangles: I32, total: F64) -> None:
    for t in range(len(triangles)):
        for k in range(3):
            for axis in range(3):
                total[triangles[t, k], axis] += normals[t, axis]


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
