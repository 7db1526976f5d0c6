"""Kernels of `plane_snapping.py`: the planes about each vertex, the shortest step onto them, and unfolding."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot, eigh
from trihedron.pipeline.core.types import F64, I32

LEAST = 0.1  # share of the strongest direction below which planes do not say where a vertex is: two that differ by less than 26°


@kernel
def planes_about(count: int, triangles: I32, labels: I32) -> tuple[I32, I32]:
    """The planes of the triangles about each vertex v, in ascending order and each once: rows[starts[v] : starts[v + 1]]."""
    ends = np.zeros(count + 1, np.int32)
    for t in range(len(triangles)):
        if labels[t] >= 0:
            for k in range(3):
                ends[triangles[t, k] + 1] += 1
    ends = np.cumsum(ends).astype(np.int32)
    rows, filled = np.empty(ends[count], np.int32), ends[:-1].copy()
    for t in range(len(triangles)):
        if labels[t] >= 0:
            for k in range(3):
                v = triangles[t, k]
                at = filled[v]
                while at > ends[v] and rows[at - 1] > labels[t]:
                    at -= 1
                if at > ends[v] and rows[at - 1] == labels[t]:
                    continue
                for i in range(filled[v], at, -1):
                    rows[i] = rows[i - 1]
                rows[at] = labels[t]
                filled[v] += 1
    starts, size = np.zeros(count + 1, np.int32), 0
    for v in range(count):
        for k in range(ends[v], filled[v]):
            rows[size] = rows[k]
            size += 1
        starts[v + 1] = size
    return rows[:size].copy(), starts


@kernel
def snap_kernel(vertices: F64, rows: I32, starts: I32, planes: F64, farthest: float) -> F64:
    """Move vertices (v, 3) onto all of their planes, or onto the nearest one where that is farther than `farthest`; those without a plane stay."""
    out = vertices.copy()
    for v in range(len(vertices)):
        a, b = starts[v], starts[v + 1]
        if a == b:
            continue
        step, length = _step(vertices[v], planes, rows[a:b])
        if length > farthest:
            nearest = a
            for k in range(a + 1, b):
                if abs(_height(vertices[v], planes[rows[k]])) < abs(_height(vertices[v], planes[rows[nearest]])):
                    nearest = k
            step, _ = _step(vertices[v], planes, rows[nearest : nearest + 1])
        for i in range(3):
            out[v, i] += step[i]
    return out


@kernel
def unfold(points: F64, triangles: I32, normals: F64, rows: I32, starts: I32) -> int:
    """Move the vertices of triangles (t, 3) that lie the wrong way round to the middle of those neighbours that are on all their planes, so that each
    stays on its plane or line; returns how many."""
    folded = np.zeros(len(points), np.bool_)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x1, y1, z1 = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        x2, y2, z2 = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        if (y1 * z2 - z1 * y2) * normals[t, 0] + (z1 * x2 - x1 * z2) * normals[t, 1] + (x1 * y2 - y1 * x2) * normals[t, 2] < 0.0:
            folded[a] = folded[b] = folded[c] = True
    total = np.zeros((len(points), 4))
    for t in range(len(triangles)):
        for k in range(3):
            v = triangles[t, k]
            if folded[v]:
                for other in (triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]):
                    if _includes(rows[starts[other] : starts[other + 1]], rows[starts[v] : starts[v + 1]]):
                        for i in range(3):
                            total[v, i] += points[other, i]
                        total[v, 3] += 1.0
    count = 0
    for v in range(len(points)):
        if total[v, 3] > 0.0:
            for i in range(3):
                points[v, i] = total[v, i] / total[v, 3]
            count += 1
    return count


@kernel(inline="always")
def _includes(larger: I32, smaller: I32) -> bool:
    """Return True if an ascending list holds another."""
    at = 0
    for wanted in smaller:
        while at < len(larger) and larger[at] < wanted:
            at += 1
        if at == len(larger) or larger[at] != wanted:
            return False
    return True


@kernel(inline="always")
def _height(p: F64, plane: F64) -> float:
    return p[0] * plane[0] + p[1] * plane[1] + p[2] * plane[2] + plane[3]


@kernel
def _step(p: F64, planes: F64, rows: I32) -> tuple[F64, float]:
    """The shortest step onto the planes, by least squares within the directions that they determine, and its length."""
    if len(rows) == 1:
        height = _height(p, planes[rows[0]])
        return -height * planes[rows[0], :3], abs(height)
    A, r = np.zeros((3, 3)), np.zeros(3)
    for k in rows:
        height = _height(p, planes[k])
        for i in range(3):
            r[i] += planes[k, i] * height
            for j in range(3):
                A[i, j] += planes[k, i] * planes[k, j]
    values, vectors = eigh(A)
    step = np.zeros(3)
    for i in range(3):
        if values[i] > LEAST * values[2]:
            length = dot(vectors[:, i], r) / values[i]
            for j in range(3):
                step[j] -= vectors[j, i] * length
    return step, np.sqrt(dot(step, step))
