"""Kernels of `half_edges.py`: pairs of half-edges, connected sets, fans and normals."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32

OPEN = -1  # beyond a half-edge: nothing, or more than one triangle


@kernel
def pair_half_edges(triangles: I32, count: int) -> I32:
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


@kernel
def triangle_components(opposite: I32, labels: I32) -> tuple[I32, int]:
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


@kernel
def _join(root: I32, a: int, b: int) -> None:
    while root[a] != a:
        root[a] = root[root[a]]
        a = root[a]
    while root[b] != b:
        root[b] = root[root[b]]
        b = root[b]
    root[max(a, b)] = min(a, b)


@kernel
def fans_kernel(opposite: I32) -> I32:
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


@kernel
def triangle_normals(vertices: F64, triangles: I32) -> F64:
    """(t, 3) normals, as long as twice the area."""
    out = np.empty((len(triangles), 3))
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x1, y1, z1 = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        x2, y2, z2 = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        out[t, 0], out[t, 1], out[t, 2] = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
    return out


@kernel
def sum_at_vertices(normals: F64, triangles: I32, total: F64) -> None:
    """Add the normals (t, 3) of triangles to `total` (v, 3) at each of their vertices."""
    for t in range(len(triangles)):
        for k in range(3):
            for axis in range(3):
                total[triangles[t, k], axis] += normals[t, axis]
