"""Kernel of `rigid_alignment.py`: the rigid motion with most inliers, from three pairs at a time (RANSAC: Fischler and Bolles, CACM 1981)."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32

LEAST_M = 0.05  # between the three points of a sample


@kernel
def _frame(a: F64, b: F64, c: F64, out: F64) -> bool:
    """Fill the axes (columns) spanned by three points; False when these are too near to each other or to a line."""
    u, v = b - a, c - a
    n = np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
    length, size = np.sqrt((u * u).sum()), np.sqrt((n * n).sum())
    if length < LEAST_M or size < LEAST_M * length:
        return False
    u, n = u / length, n / size
    out[:, 0], out[:, 1] = u, n
    out[0, 2], out[1, 2], out[2, 2] = u[1] * n[2] - u[2] * n[1], u[2] * n[0] - u[0] * n[2], u[0] * n[1] - u[1] * n[0]
    return True


@kernel
def best_motion(before: F64, after: F64, reach: F64, samples: I32) -> tuple[F64, F64]:
    """Return R and t of the sample (m, 3) with most pairs of points (n, 3) within `reach` (n,)."""
    best, R_best, t_best = -1, np.eye(3), np.zeros(3)
    A, B, R, t = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for s in range(len(samples)):
        i, j, k = samples[s]
        if not (_frame(before[i], before[j], before[k], A) and _frame(after[i], after[j], after[k], B)):
            continue
        for r in range(3):
            for c in range(3):
                R[r, c] = B[r, 0] * A[c, 0] + B[r, 1] * A[c, 1] + B[r, 2] * A[c, 2]
        for r in range(3):
            t[r] = 0.0
            for m in (i, j, k):
                t[r] += (after[m, r] - R[r, 0] * before[m, 0] - R[r, 1] * before[m, 1] - R[r, 2] * before[m, 2]) / 3.0
        count = 0
        for m in range(len(before)):
            total = 0.0
            for r in range(3):
                e = R[r, 0] * before[m, 0] + R[r, 1] * before[m, 1] + R[r, 2] * before[m, 2] + t[r] - after[m, r]
                total += e * e
            count += total < reach[m] * reach[m]
        if count > best:
            best, R_best, t_best = count, R.copy(), t.copy()
    return R_best, t_best
