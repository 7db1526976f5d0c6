"""The rotation nearest to measured directions in closed form (orthogonal Procrustes: Schönemann, Psychometrika 1966)."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.algebra.small_linear import fill_tangent_basis, inverse_positive, polar_rotation


@numba.njit(cache=True, nogil=True, error_model="numpy")
def procrustes(directions: F64, weights: F64, axes: I32, R: F64, prior: float) -> F64:
    """`argmin Σ w |±n − R e|² + prior/2 Σ |R_before e − R e|²` over rotations (3, 3): directions n (n, 3) with weights (n,), each on the column
    `axes[i]` of R, signs as R has them; -1 takes no part. The small prior keeps what no direction tells."""
    return polar_rotation(0.5 * prior * R + _sums(directions, weights, axes, R))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def procrustes_covariance(covariance: F64, weights: F64, axes: I32, R: F64, prior: float, scale: float) -> F64:
    """(3, 3) of phi in `R <- Exp(phi) R` for R from `procrustes`, when the directions have the 3D covariance C (n, 3, 3), which need not be that of
    the weights: `A⁻¹ (scale Σ w² [a]× C [a]×ᵀ + prior) A⁻¹` with `A = Σ w (1 − a aᵀ) + prior` and a the axis of each."""
    A, B = _normal_equations(covariance, weights, axes, R)
    inverse, out = inverse_positive(A + prior * np.eye(3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    out[i, j] += inverse[i, k] * (scale * B[k, m] + prior * (k == m)) * inverse[m, j]
    return 0.5 * (out + out.T)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def normal_covariance(planes: F64, covariance: F64, floor: float) -> F64:
    """(n, 3, 3) covariance in 3D, rad², of the normals of planes (n, 4) with `covariance` (n, 3, 3) of (a, b, d), see `types.Planes`; `floor` (rad)
    is added in square."""
    out, basis = np.zeros((len(planes), 3, 3)), np.empty((2, 3))
    for i in range(len(planes)):
        fill_tangent_basis(planes[i], basis)
        for j in range(3):
            for k in range(3):
                for u in range(2):
                    for v in range(2):
                        out[i, j, k] += basis[u, j] * (covariance[i, u, v] + floor * floor * (u == v)) * basis[v, k]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def square_angles(directions: F64, axes: I32, R: F64) -> F64:
    """(n,) squared sine of the angle between each direction and its column of R; 0 without one."""
    out = np.zeros(len(directions))
    for i in range(len(directions)):
        k = axes[i]
        if k >= 0:
            dot = directions[i, 0] * R[0, k] + directions[i, 1] * R[1, k] + directions[i, 2] * R[2, k]
            out[i] = max(1.0 - dot * dot, 0.0)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def inliers_and_spread(square: F64, axes: I32, weights: F64) -> tuple[I32, F64]:
    """(3,) number of the directions on each axis, and their root mean square angle, rad, by weight; NaN on an axis without. `square` from
    `square_angles`."""
    counts, sums = np.zeros(3, np.int32), np.zeros((2, 3))
    for i in range(len(axes)):
        if axes[i] >= 0:
            counts[axes[i]] += 1
            sums[0, axes[i]] += weights[i]
            sums[1, axes[i]] += weights[i] * square[i]
    return counts, np.where(sums[0] > 0.0, np.sqrt(sums[1] / np.maximum(sums[0], 1e-300)), np.nan)


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
