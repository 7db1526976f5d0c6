"""The rotation nearest to measured directions in closed form (orthogonal Procrustes: Schönemann, Psychometrika 1966)."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.geometry import nearest_rotation, tangent_basis
from trihedron.pipeline.types import F64, I32


def procrustes(directions: F64, weights: F64, axes: I32, R: F64, prior: float) -> F64:
    """`argmin Σ w |±n − R e|² + prior/2 Σ |R_before e − R e|²` over rotations (3, 3): directions n (n, 3) with weights (n,), each on the column
    `axes[i]` of R, signs as R has them; -1 takes no part. The small prior keeps what no direction tells."""
    return nearest_rotation(0.5 * prior * R + _sums(directions, weights, axes, R))


def procrustes_covariance(covariance: F64, weights: F64, axes: I32, R: F64, prior: float, scale: float) -> F64:
    """(3, 3) of phi in `R <- Exp(phi) R` for R from `procrustes`, when the directions have the 3D covariance C (n, 3, 3), which need not be that of
    the weights: `A⁻¹ (scale Σ w² [a]× C [a]×ᵀ + prior) A⁻¹` with `A = Σ w (1 − a aᵀ) + prior` and a the axis of each."""
    A, B = _normal_equations(covariance, weights, axes, R)
    inverse = np.linalg.inv(A + prior * np.eye(3))
    out = inverse @ (scale * B + prior * np.eye(3)) @ inverse
    return np.asarray(0.5 * (out + out.T))


def normal_covariance(planes: F64, covariance: F64, floor: float) -> F64:
    """(n, 3, 3) covariance in 3D, rad², of the normals of planes (n, 4) with `covariance` of (a, b, d), see `types.Planes`; `floor` (rad) is added in
    square."""
    basis = tangent_basis(planes[:, :3])
    return np.asarray(basis @ (covariance[:, :2, :2] + floor * floor * np.eye(2)) @ np.swapaxes(basis, 1, 2))


@numba.njit(cache=True, nogil=True)
def square_angles(directions: F64, axes: I32, R: F64) -> F64:
    """(n,) squared sine of the angle between each direction and its column of R; 0 without one."""
    out = np.zeros(len(directions))
    for i in range(len(directions)):
        k = axes[i]
        if k >= 0:
            dot = directions[i, 0] * R[0, k] + directions[i, 1] * R[1, k] + directions[i, 2] * R[2, k]
            out[i] = max(1.0 - dot * dot, 0.0)
    return out


@numba.njit(cache=True, nogil=True)
def _sums(directions: F64, weights: F64, axes: I32, R: F64) -> F64:
    """(3, 3) `Σ w ±n eᵀ`."""
    M = np.zeros((3, 3))
    for i in range(len(directions)):
        k = axes[i]
        if k >= 0:
            dot = directions[i, 0] * R[0, k] + directions[i, 1] * R[1, k] + directions[i, 2] * R[2, k]
            w = weights[i] if dot > 0.0 else -weights[i]
            for j in range(3):
                M[j, k] += w * directions[i, j]
    return M


@numba.njit(cache=True, nogil=True)
def _normal_equations(covariance: F64, weights: F64, axes: I32, R: F64) -> tuple[F64, F64]:
    """(3, 3) `Σ w (1 − a aᵀ)` and (3, 3) `Σ w² [a]× C [a]×ᵀ`."""
    A, B, row = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(len(weights)):
        k = axes[i]
        if k < 0:
            continue
        a, w, C = R[:, k], weights[i], covariance[i]
        for p in range(3):
            q, r = (p + 1) % 3, (p + 2) % 3
            A[p, p] += w
            for j in range(3):
                A[p, j] -= w * a[p] * a[j]
                row[p, j] = a[q] * C[r, j] - a[r] * C[q, j]  # [a]× C
        for p in range(3):
            for j in range(3):
                q, r = (j + 1) % 3, (j + 2) % 3
                B[p, j] += w * w * (row[p, r] * a[q] - row[p, q] * a[r])
    return A, B
