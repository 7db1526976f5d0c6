"""Vertices of planar parts moved onto their planes: one plane, the line where two meet, the point where three do."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F64, I32, Bool

LEAST = 0.1  # share of the strongest direction below which planes do not say where a vertex is: two that differ by less than 26°
ROUNDS = 20  # at most, to unfold what lies the wrong way round after it was moved


def snapped(vertices: F64, triangles: I32, labels: I32, planes: F64, farthest_m: float) -> F64:
    """Vertices (v, 3), each moved to the nearest point that lies on all planes of the triangles about it, or, if that is too far, on the nearest
    plane."""
    planar = labels >= 0
    size = len(planes) + 1
    keys = np.unique(triangles[planar].astype(np.int64) * size + labels[planar][:, None])
    starts = np.searchsorted(keys, np.arange(len(vertices) + 1, dtype=np.int64) * size)
    points = _snapped(vertices, (keys % size).astype(np.int32), starts.astype(np.int32), planes, farthest_m)
    rows = np.flatnonzero(planar)
    for _ in range(ROUNDS):
        if not _unfold(points, triangles[rows], planes[labels[rows], :3], np.diff(starts) == 1):
            break
    return points


@numba.njit(cache=True, nogil=True)
def _snapped(vertices: F64, rows: I32, starts: I32, planes: F64, farthest: float) -> F64:
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
        out[v] += step
    return out


@numba.njit(cache=True, nogil=True)
def _unfold(points: F64, triangles: I32, normals: F64, single: Bool) -> int:
    """Move vertices of one plane alone (v,) whose triangles (t, 3) lie the wrong way round to the middle of their neighbours; returns how many."""
    folded = np.zeros(len(points), np.bool_)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        x1, y1, z1 = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        x2, y2, z2 = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        if (y1 * z2 - z1 * y2) * normals[t, 0] + (z1 * x2 - x1 * z2) * normals[t, 1] + (x1 * y2 - y1 * x2) * normals[t, 2] < 0.0:
            for k in range(3):
                folded[triangles[t, k]] = single[triangles[t, k]]
    total = np.zeros((len(points), 4))
    for t in range(len(triangles)):
        for k in range(3):
            if folded[triangles[t, k]]:
                for other in (triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]):
                    total[triangles[t, k], :3] += points[other]
                    total[triangles[t, k], 3] += 1.0
    count = 0
    for v in range(len(points)):
        if folded[v]:
            points[v] = total[v, :3] / total[v, 3]
            count += 1
    return count


@numba.njit(cache=True, nogil=True, inline="always")
def _height(p: F64, plane: F64) -> float:
    return p[0] * plane[0] + p[1] * plane[1] + p[2] * plane[2] + plane[3]


@numba.njit(cache=True, nogil=True)
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
    values, vectors = np.linalg.eigh(A)
    step = np.zeros(3)
    for i in range(3):
        if values[i] > LEAST * values[2]:
            step -= vectors[:, i] * (np.dot(vectors[:, i], r) / values[i])
    return step, np.sqrt(np.dot(step, step))
