"""How well planes and lines tell a direction: information (n, 3, 3) in 1/rad², zero along the direction itself."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64
from trihedron.plugins.numerics.algebra.small_linear import fill_tangent_basis


@numba.njit(cache=True, nogil=True, error_model="numpy")
def measured_directions(
    planes: F64, plane_covariance: F64, plane_floor: float, ends_m: F32, end_covariance: F32, line_floor: float, means: F64, mean_sigma: F64
) -> tuple[F64, F64]:
    """Directions (n, 3) and their information: the normals of planes (p, 4) with covariances (p, 3, 3) of (a, b, d), see `types.Planes`; lines
    through end points (l, 2, 3) with covariances (l, 2, 3, 3) each; and `means` (m, 3) known to `mean_sigma` (m,) every way. The floors (rad) are
    added in square. A row that is not finite tells nothing: its information is zero."""
    p, lines = len(planes), len(ends_m)
    vectors, information = np.empty((p + lines + len(means), 3)), np.zeros((p + lines + len(means), 3, 3))
    C, a = np.empty((2, 2)), np.empty((2, 3))
    for i in range(p):
        known = np.isfinite(planes[i, 0] + planes[i, 1] + planes[i, 2])
        for k in range(3):
            vectors[i, k] = planes[i, k] if known else np.nan
        fill_tangent_basis(vectors[i], a)
        _inverse_in_tangent_plane(plane_covariance[i], plane_floor * plane_floor, a, information[i])
    for i in range(lines):
        d = vectors[p + i]
        length2 = 0.0
        for k in range(3):
            d[k] = float(ends_m[i, 1, k]) - ends_m[i, 0, k]
            length2 += d[k] * d[k]
        known = 1e-12 < length2 < np.inf
        for k in range(3):
            d[k] = d[k] / np.sqrt(length2) if known else np.nan
        if not known:
            continue
        fill_tangent_basis(d, a)
        for u in range(2):
            for v in range(2):
                C[u, v] = 0.0
                for j in range(3):
                    for k in range(3):
                        C[u, v] += a[u, j] * (float(end_covariance[i, 0, j, k]) + end_covariance[i, 1, j, k]) * a[v, k] / length2
        _inverse_in_tangent_plane(C, line_floor * line_floor, a, information[p + i])
    for i in range(len(means)):
        for j in range(3):
            vectors[p + lines + i, j] = means[i, j]
            for k in range(3):
                information[p + lines + i, j, k] = (1.0 * (j == k) - means[i, j] * means[i, k]) / mean_sigma[i] ** 2
    return vectors, information


def isotropic_information(directions: F64, sigma: F64) -> F64:
    """(n, 3) directions known to `sigma` (n,) rad every way."""
    return (np.eye(3) - directions[:, :, None] * directions[:, None, :]) / (sigma * sigma)[:, None, None]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inverse_in_tangent_plane(C: F64, more: float, basis: F64, out: F64) -> None:
    """Write the information (3, 3) of a direction with covariance C (2, 2) plus `more` in its tangent plane, the rows of `basis`; nothing where that
    is no covariance."""
    p, q, r = C[0, 0] + more, C[0, 1], C[1, 1] + more
    det = p * r - q * q
    if not (0.0 < det < np.inf and p > 0.0):
        return
    for j in range(3):
        u, v = basis[0, j], basis[1, j]
        for k in range(3):
            out[j, k] = (r * u * basis[0, k] - q * (u * basis[1, k] + v * basis[0, k]) + p * v * basis[1, k]) / det
