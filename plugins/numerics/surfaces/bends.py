"""How curved the parts of a mesh are."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.surfaces.plane_axes import plane_axes


def bends(parts: I32, count: int, labels: I32, middle: F64, area: F64, planes: F64) -> F64:
    """(count,) larger principal curvature (1/m) of the quadric of least squares over each part's plane; 0 for parts without one."""
    frames = np.array([np.column_stack([plane_axes(plane), plane[:3]]) for plane in planes]).reshape(-1, 3, 3)
    return _bends(parts, count, labels, middle, area, frames)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bends(parts: I32, count: int, labels: I32, middle: F64, area: F64, frames: F64) -> F64:
    centre, total = np.zeros((count, 3)), np.zeros(count)
    for t in range(len(parts)):
        if labels[t] >= 0:
            c = parts[t]
            total[c] += area[t]
            for k in range(3):
                centre[c, k] += area[t] * middle[t, k]
    normal, right, bend, row = np.zeros((count, 6, 6)), np.zeros((count, 6)), np.zeros(count), np.empty(6)
    for t in range(len(parts)):
        if labels[t] < 0:
            continue
        c, F = parts[t], frames[labels[t]]
        px, py, pz = middle[t, 0] - centre[c, 0] / total[c], middle[t, 1] - centre[c, 1] / total[c], middle[t, 2] - centre[c, 2] / total[c]
        x = F[0, 0] * px + F[1, 0] * py + F[2, 0] * pz
        y = F[0, 1] * px + F[1, 1] * py + F[2, 1] * pz
        z = F[0, 2] * px + F[1, 2] * py + F[2, 2] * pz
        row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, x, y, 0.5 * x * x, x * y, 0.5 * y * y
        for i in range(6):
            weighed = area[t] * row[i]
            right[c, i] += weighed * z
            for j in range(i + 1):
                normal[c, i, j] += weighed * row[j]
    for c in range(count):
        if total[c] > 0.0:
            for i in range(6):
                normal[c, :i, i] = normal[c, i, :i]
            for i in range(3, 6):
                normal[c, i, i] += 1e-9 * total[c]  # a strip says nothing of its curvature across
            q = np.linalg.solve(normal[c] + 1e-12 * np.eye(6), right[c])
            bend[c] = abs(0.5 * (q[3] + q[5])) + np.sqrt(0.25 * (q[3] - q[5]) ** 2 + q[4] ** 2)
    return bend
