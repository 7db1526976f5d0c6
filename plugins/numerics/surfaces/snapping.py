"""Vertices of planar parts moved onto their planes: one plane, the line where two meet, the point where three do."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F64, I32

LEAST = 0.1  # share of the strongest direction below which planes do not say where a vertex is: two that differ by less than 26°


def snapped(vertices: F64, triangles: I32, labels: I32, planes: F64, farthest_m: float) -> F64:
    """Vertices (v, 3), each moved to the nearest point that lies on all planes of the triangles about it, or, if that is too far, on the nearest
    plane."""
    planar = labels >= 0
    size = len(planes) + 1
    keys = np.unique(triangles[planar].astype(np.int64) * size + labels[planar][:, None])
    starts = np.searchsorted(keys, np.arange(len(vertices) + 1, dtype=np.int64) * size)
    return _snapped(vertices, (keys % size).astype(np.int32), starts.astype(np.int32), planes, farthest_m)


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
