"""Distances from points to meshes, and points spread over them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32

I64 = NDArray[np.int64]
SPACING_M = 0.02  # between the samples that say which triangles are near
NEAREST = 12  # samples whose triangles are looked at
FAR_M = 0.5  # where a distance ends


def areas(vertices: F64, triangles: I32) -> F64:
    """(t,) areas of triangles."""
    corners = vertices[triangles]
    return np.asarray(0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1), np.float64)


def sample_triangles(vertices: F64, triangles: I32, spacing_m: float) -> tuple[F64, I32, F64]:
    """Points (n, 3) on a regular barycentric grid of each triangle, at most about `spacing_m` apart, their triangles (n,), and the area (m²) each
    stands for."""
    corners = vertices[triangles]
    longest = np.sqrt(np.max([((corners[:, k] - corners[:, k - 1]) ** 2).sum(axis=1) for k in range(3)], axis=0)) if len(triangles) else np.empty(0)
    parts = np.maximum(np.ceil(longest / spacing_m), 1).astype(np.int64)
    points, owner = _grid(corners, parts)
    counts = np.bincount(owner, minlength=len(triangles))
    return points, owner, (areas(vertices, triangles) / np.maximum(counts, 1))[owner]


@kernel(error_model="python")
def _grid(corners: F64, parts: I64) -> tuple[F64, I32]:
    """The centres of the n² similar triangles that each triangle is cut into."""
    total = 0
    for t in range(len(parts)):
        total += parts[t] * parts[t]
    points, owner, at = np.empty((total, 3)), np.empty(total, np.int32), 0
    for t in range(len(parts)):
        n = parts[t]
        for i in range(n):
            for j in range(n - i):
                for turned in range(2 if i + j < n - 1 else 1):
                    a, b = (i + (2 if turned else 1) / 3.0) / n, (j + (2 if turned else 1) / 3.0) / n
                    for k in range(3):
                        points[at, k] = corners[t, 0, k] + a * (corners[t, 1, k] - corners[t, 0, k]) + b * (corners[t, 2, k] - corners[t, 0, k])
                    owner[at] = t
                    at += 1
    return points, owner


class NearestTriangle:
    """Exact distances to the triangles that are near by samples of them."""

    def __init__(self, vertices: F64, triangles: I32) -> None:
        from scipy.spatial import cKDTree

        self._corners = vertices[triangles]
        points, self._owner, _ = sample_triangles(vertices, triangles, SPACING_M)
        self._tree = cKDTree(points) if len(points) else None

    def query(self, points: F64) -> tuple[F64, I32]:
        """(n,) distances in metres, FAR_M at most, and the nearest triangles (n,), -1 beyond that."""
        if self._tree is None or len(points) == 0:
            return np.full(len(points), FAR_M), np.full(len(points), -1, np.int32)
        _, found = self._tree.query(points, k=min(NEAREST, self._tree.n), distance_upper_bound=FAR_M)
        owner = np.append(self._owner, -1)[found.reshape(len(points), -1)]
        return _nearest(np.ascontiguousarray(points), self._corners, owner.astype(np.int32), FAR_M)


@kernel(error_model="python")
def _nearest(points: F64, corners: F64, candidates: I32, far: float) -> tuple[F64, I32]:
    distance, nearest = np.full(len(points), far), np.full(len(points), -1, np.int32)
    for i in range(len(points)):
        last = -1
        for t in candidates[i]:
            if t < 0 or t == last:
                continue
            last = t
            d = _distance(points[i], corners[t, 0], corners[t, 1], corners[t, 2])
            if d < distance[i]:
                distance[i], nearest[i] = d, t
    return distance, nearest


@kernel(error_model="python")
def _distance(p: F64, a: F64, b: F64, c: F64) -> float:
    """Distance from a point to a triangle (Ericson, Real-Time Collision Detection, 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = np.dot(ab, ap), np.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return float(np.sqrt(np.dot(ap, ap)))
    bp = p - b
    d3, d4 = np.dot(ab, bp), np.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return float(np.sqrt(np.dot(bp, bp)))
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        q = ap - ab * (d1 / max(d1 - d3, 1e-300))
        return float(np.sqrt(np.dot(q, q)))
    cp = p - c
    d5, d6 = np.dot(ab, cp), np.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return float(np.sqrt(np.dot(cp, cp)))
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        q = ap - ac * (d2 / max(d2 - d6, 1e-300))
        return float(np.sqrt(np.dot(q, q)))
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        q = bp - (c - b) * ((d4 - d3) / max((d4 - d3) + (d5 - d6), 1e-300))
        return float(np.sqrt(np.dot(q, q)))
    total = va + vb + vc
    if total <= 0.0:  # without area: nearest to a corner
        return float(min(np.sqrt(np.dot(ap, ap)), np.sqrt(np.dot(bp, bp)), np.sqrt(np.dot(cp, cp))))
    q = ap - ab * (vb / total) - ac * (vc / total)
    return float(np.sqrt(np.dot(q, q)))
