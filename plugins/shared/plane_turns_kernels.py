"""Kernel of `plane_turns.py`: the rotation that normals of planes show."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import solve_positive
from trihedron.pipeline.core.types import F64

ROUNDS = 12  # of reweighted least squares
LEAST_RESIDUAL = 0.5  # standard deviations, below which residuals count squared, beyond by their size


@kernel
def rotation_of_normals(before: F64, now: F64, variance: F64, importance: F64, R: F64, prior: float) -> F64:
    """Small rotation vector (3,) from the normals (n, 3) `before`, rotated by the transpose of R (3, 3), to those of `now`, that has the least sum of
    residuals, each times the plane's `importance` (n,).

    `variance` (n,) is that of each normal's direction (rad²), `prior` the standard deviation (rad) that shrinks what no plane shows towards zero."""
    n = len(before)
    predicted, difference, weights = np.empty((n, 3)), np.empty((n, 3)), np.ones(n)
    for i in range(n):
        for k in range(3):
            predicted[i, k] = R[0, k] * before[i, 0] + R[1, k] * before[i, 1] + R[2, k] * before[i, 2]
        along = now[i, 0] * predicted[i, 0] + now[i, 1] * predicted[i, 1] + now[i, 2] * predicted[i, 2]
        for k in range(3):
            difference[i, k] = (now[i, k] if along > 0.0 else -now[i, k]) - predicted[i, k]
    r, H, g = np.zeros(3), np.empty((3, 3)), np.empty(3)
    for _ in range(ROUNDS):
        for a in range(3):
            g[a] = 0.0
            for b in range(3):
                H[a, b] = 1.0 / (prior * prior) if a == b else 0.0
        for i in range(n):
            w, p, d = weights[i] * importance[i] / variance[i], predicted[i], difference[i]
            squared = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
            for a in range(3):
                for b in range(3):
                    H[a, b] += w * ((squared if a == b else 0.0) - p[a] * p[b])
            g[0] += w * (p[1] * d[2] - p[2] * d[1])
            g[1] += w * (p[2] * d[0] - p[0] * d[2])
            g[2] += w * (p[0] * d[1] - p[1] * d[0])
        solve_positive(H, g, r)
        for i in range(n):
            p, d = predicted[i], difference[i]
            x = d[0] - (r[1] * p[2] - r[2] * p[1])
            y = d[1] - (r[2] * p[0] - r[0] * p[2])
            z = d[2] - (r[0] * p[1] - r[1] * p[0])
            weights[i] = 1.0 / max(np.sqrt((x * x + y * y + z * z) / variance[i]), LEAST_RESIDUAL)
    return r
