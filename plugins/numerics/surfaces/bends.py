"""How curved the parts of a mesh are."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F64, I32


@numba.njit(cache=True, nogil=True)
def bends(parts: I32, count: int, labels: I32, middle: F64, area: F64, planes: F64) -> F64:
    """(count,) larger principal curvature (1/m) of the quadric of least squares over each part's plane; 0 for parts without one."""
    centre, total = np.zeros((count, 3)), np.zeros(count)
    for t in range(len(parts)):
        centre[parts[t]] += area[t] * middle[t]
        total[parts[t]] += area[t]
    normal = np.zeros((count, 6, 6))
    right = np.zeros((count, 6))
    bend = np.zeros(count)
    row = np.empty(6)
    for t in range(len(parts)):
        if labels[t] < 0:
            continue
        c, n = parts[t], planes[labels[t]]
        p = middle[t] - centre[c] / total[c]
        x, y = _flat(p, n)
        z = np.dot(p, n[:3])
        row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, x, y, 0.5 * x * x, x * y, 0.5 * y * y
        for i in range(6):
            right[c, i] += area[t] * row[i] * z
            for j in range(6):
                normal[c, i, j] += area[t] * row[i] * row[j]
    for c in range(count):
        if normal[c, 0, 0] > 0.0:
            for i in range(3, 6):
                normal[c, i, i] += 1e-9 * total[c]  # a strip says nothing of its curvature across
            q = np.linalg.solve(normal[c] + 1e-12 * np.eye(6), right[c])
            mean, off = 0.5 * (q[3] + q[5]), np.sqrt(0.25 * (q[3] - q[5]) ** 2 + q[4] ** 2)
            bend[c] = abs(mean) + off
    return bend


@numba.njit(cache=True, nogil=True, inline="always")
def _flat(p: F64, n: F64) -> tuple[float, float]:
    """Coordinates of p along two axes at right angles to n."""
    if abs(n[0]) < 0.7:
        a0, a1, a2 = 0.0, n[2], -n[1]
    else:
        a0, a1, a2 = -n[2], 0.0, n[0]
    length = np.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
    a0, a1, a2 = a0 / length, a1 / length, a2 / length
    b0, b1, b2 = n[1] * a2 - n[2] * a1, n[2] * a0 - n[0] * a2, n[0] * a1 - n[1] * a0
    return p[0] * a0 + p[1] * a1 + p[2] * a2, p[0] * b0 + p[1] * b1 + p[2] * b2
