"""Steps of the pose solver: motions on SE(3), the Gaussian prior and the damped normal equations, for numba loops."""

from __future__ import annotations

import math

import numba
import numpy as np

from trihedron.pipeline.core.types import F64


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rotation(x: float, y: float, z: float) -> F64:
    """Exp(phi) of phi = (x, y, z), Rodrigues."""
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-12:
        a, b = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    E = np.empty((3, 3))
    E[0, 0], E[1, 1], E[2, 2] = 1.0 - b * (y * y + z * z), 1.0 - b * (x * x + z * z), 1.0 - b * (x * x + y * y)
    E[0, 1], E[0, 2], E[1, 2] = b * x * y - a * z, b * x * z + a * y, b * y * z - a * x
    E[1, 0], E[2, 0], E[2, 1] = b * x * y + a * z, b * x * z - a * y, b * y * z + a * x
    return E


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rotation_vector(R: F64) -> tuple[float, float, float]:
    """Log(R) for angles below π (a prior is never that far)."""
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    s, c = math.sqrt(x * x + y * y + z * z), 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    scale = math.atan2(s, c) / s if s > 1e-9 else 1.0
    return x * scale, y * scale, z * scale


@numba.njit(cache=True, nogil=True, error_model="numpy")
def move(R: F64, t: F64, dx: F64, turned: F64, shifted: F64) -> None:
    """The pose after the step (rho, phi) into the last two: R Exp(phi), t + R rho; agrees with Exp(xi) to first order, which is what covariances
    mean."""
    E = _rotation(dx[3], dx[4], dx[5])
    for i in range(3):
        shifted[i] = t[i] + R[i, 0] * dx[0] + R[i, 1] * dx[1] + R[i, 2] * dx[2]
        for j in range(3):
            turned[i, j] = R[i, 0] * E[0, j] + R[i, 1] * E[1, j] + R[i, 2] * E[2, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_prior(R: F64, t: F64, R_prior: F64, t_prior: F64, prior: F64, H: F64, g: F64) -> float:
    """Add the prior's term to H (lower triangle) and g; returns its cost."""
    delta, r, J, e = np.zeros((3, 3)), np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    for i in range(3):
        for k in range(3):
            r[i] += R_prior[k, i] * (t[k] - t_prior[k])
            for j in range(3):
                delta[i, j] += R_prior[k, i] * R[k, j]
    r[3], r[4], r[5] = _rotation_vector(delta)
    for i in range(3):
        J[3 + i, 3 + i] = 1.0  # with the terms below the inverse right Jacobian, first order
        for j in range(3):
            J[i, j] = delta[i, j]
    J[3, 4], J[3, 5], J[4, 5] = -0.5 * r[5], 0.5 * r[4], -0.5 * r[3]
    J[4, 3], J[5, 3], J[5, 4] = 0.5 * r[5], -0.5 * r[4], 0.5 * r[3]
    cost = 0.0
    for a in range(6):
        for b in range(6):
            e[a] += prior[a, b] * r[b]
        cost += e[a] * r[a]
    for a in range(6):
        for k in range(a // 3 * 3, a // 3 * 3 + 3):  # J is two blocks
            g[a] += J[k, a] * e[k]
            for b in range(a + 1):
                for j in range(b // 3 * 3, b // 3 * 3 + 3):
                    H[a, b] += J[k, a] * prior[k, j] * J[j, b]
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def step(H: F64, g: F64, damping: float, free: int, dx: F64) -> None:
    """dx (6,): solution of (H + damping · diag H) dx = -g over the first `free` unknowns, by Cholesky; zero if H is not positive definite."""
    L = np.zeros((6, 6))
    for i in range(6):
        dx[i] = 0.0
    for i in range(free):
        for j in range(i + 1):
            total = H[i, j] * (1.0 + damping if i == j else 1.0)
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return
                L[i, i] = np.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    for i in range(free):
        dx[i] = -g[i]
        for k in range(i):
            dx[i] -= L[i, k] * dx[k]
        dx[i] /= L[i, i]
    for i in range(free - 1, -1, -1):
        for k in range(i + 1, free):
            dx[i] -= L[k, i] * dx[k]
        dx[i] /= L[i, i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def size(H: F64, dx: F64) -> float:
    """Squared length of the step in standard deviations (H lower triangle)."""
    total = 0.0
    for a in range(6):
        for b in range(a + 1):
            total += H[a, b] * dx[a] * dx[b] * (1.0 if a == b else 2.0)
    return total
