"""Small dense algebra for numba loops, written out: it compiles in a fraction of the time of NumPy's."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F64


@numba.njit(cache=True, nogil=True)
def solve_positive(H: F64, g: F64, x: F64) -> bool:
    """x (n,) with `H x = g` for a symmetric positive definite H (n, n), by Cholesky; False, and x zero, when H is not positive definite."""
    n = len(g)
    L = np.zeros((n, n))
    for i in range(n):
        x[i] = 0.0
    for i in range(n):
        for j in range(i + 1):
            total = H[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = total / L[j, j]
            elif total > 0.0:
                L[i, i] = np.sqrt(total)
            else:
                return False
    for i in range(n):
        x[i] = g[i]
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return True


@numba.njit(cache=True, nogil=True)
def turn_left(phi: F64, R: F64) -> None:
    """`R <- Exp(phi) R` in place, for the first three numbers of phi (Rodrigues)."""
    x, y, z = phi[0], phi[1], phi[2]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-12:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    for c in range(3):
        u, v, w = R[0, c], R[1, c], R[2, c]
        p, q, r = y * w - z * v, z * u - x * w, x * v - y * u  # phi × column
        R[0, c] = u + a * p + b * (y * r - z * q)
        R[1, c] = v + a * q + b * (z * p - x * r)
        R[2, c] = w + a * r + b * (x * q - y * p)
