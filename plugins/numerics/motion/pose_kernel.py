"""The numba loops of the pose solver: normal equations of point, line and plane terms."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, U8
from trihedron.plugins.numerics.motion.pose_noise import Weights
from trihedron.plugins.numerics.motion.pose_terms import (
    NEAR_M,
    LineTerms,
    PlaneTerms,
    PointTerms,
    basis,
    depth_direction,
    plane_rows,
)

CHI2_1, CHI2_2, CHI2_3 = 3.841, 5.991, 7.815  # 95 % of χ² with 1, 2, 3 degrees of freedom
BEHIND = 10.0 * CHI2_3  # cost of a term that cannot be projected: as bad as a gross outlier, so that no step profits from it
OUTLIER, INLIER, NO_DEPTH = 0, 1, 2  # flags of a term; NO_DEPTH is a line whose image part alone fits


class Flags(NamedTuple):
    """OUTLIER, INLIER or NO_DEPTH of each term."""

    points: U8
    lines: U8
    planes: U8


class Chi2(NamedTuple):
    """Squared whitened residual of each term; inf when it cannot be projected (a line without depth has inf in `line_depths`)."""

    points: F64
    lines: F64
    line_depths: F64
    planes: F64


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _chi2(r: F64, W: F64, rows: int, e: F64) -> float:
    """rᵀ W r, with `e = W r` left for `_add`."""
    chi2 = 0.0
    for i in range(rows):
        e[i] = 0.0
        for j in range(rows):
            e[i] += W[i, j] * r[j]
        chi2 += e[i] * r[i]
    return chi2


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _huber(chi2: float, limit: float, robust: bool) -> tuple[float, float]:
    """Weight and cost of a term whose χ² may lie beyond the limit."""
    if robust and chi2 > limit:
        return np.sqrt(limit / chi2), 2.0 * np.sqrt(limit * chi2) - limit
    return 1.0, chi2


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _add(chi2: float, e: F64, J: F64, rows: int, W: F64, limit: float, robust: bool, first: int, H: F64, g: F64) -> float:
    """Add one term, which does not know of the unknowns before the `first`, to the normal equations `H dx = -g` (Huber beyond `limit` when
    robust); returns its cost."""
    w, cost = _huber(chi2, limit, robust)
    for i in range(rows):
        for b in range(first, 6):
            WJ = 0.0
            for j in range(rows):
                WJ += w * W[i, j] * J[j, b]
            g[b] += w * e[i] * J[i, b]
            for a in range(b, 6):
                H[a, b] += J[i, a] * WJ
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_points(
    R: F64, t: F64, camera: F64, terms: PointTerms, W: F64, flags: U8, robust: bool, free: int, H: F64, g: F64, chi2: F64
) -> float:
    """All points; `point_rows` written out in scalars, since points are most of the work.

    With D = dr/dp, A = DᵀWD, b = DᵀWr and P = [p]×, J = (-D, DP) gives the blocks A, PA, -PAP and -b, -p × b."""
    cost = 0.0
    for i in range(len(terms.positions_m)):
        x, y, z = terms.positions_m[i, 0] - t[0], terms.positions_m[i, 1] - t[1], terms.positions_m[i, 2] - t[2]
        p0, p1, p2 = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z, R[0, 1] * x + R[1, 1] * y + R[2, 1] * z, R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
        chi2[i] = np.inf
        if not p2 > NEAR_M:
            cost += BEHIND if flags[i] else 0.0
            continue
        iz = 1.0 / p2
        d00, d11, d22, r2 = camera[0] * iz, camera[1] * iz, 0.0, 0.0
        d02, d12 = -d00 * p0 * iz, -d11 * p1 * iz
        r0, r1 = d00 * p0 + camera[2] - terms.pixels[i, 0], d11 * p1 + camera[3] - terms.pixels[i, 1]
        if np.isfinite(terms.depth_m[i]):
            r2, d22 = iz - 1.0 / terms.depth_m[i], -iz * iz
        w00, w01, w02, w11, w12, w22 = W[i, 0, 0], W[i, 0, 1], W[i, 0, 2], W[i, 1, 1], W[i, 1, 2], W[i, 2, 2]
        e0, e1, e2 = w00 * r0 + w01 * r1 + w02 * r2, w01 * r0 + w11 * r1 + w12 * r2, w02 * r0 + w12 * r1 + w22 * r2
        value = e0 * r0 + e1 * r1 + e2 * r2
        if not value < np.inf:  # NaN, or a noise that has no inverse
            cost += BEHIND if flags[i] else 0.0
            continue
        chi2[i] = value
        if not flags[i]:
            continue
        w, share = _huber(value, CHI2_3 if w22 > 0.0 else CHI2_2, robust)
        cost += share
        a00, a11, a01 = w * d00 * d00 * w00, w * d11 * d11 * w11, w * d00 * d11 * w01
        a02 = w * d00 * (w00 * d02 + w01 * d12 + w02 * d22)
        a12 = w * d11 * (w01 * d02 + w11 * d12 + w12 * d22)
        a22 = w * (d02 * d02 * w00 + d12 * d12 * w11 + d22 * d22 * w22 + 2.0 * (d02 * d12 * w01 + d02 * d22 * w02 + d12 * d22 * w12))
        b0, b1, b2 = w * d00 * e0, w * d11 * e1, w * (d02 * e0 + d12 * e1 + d22 * e2)
        H[0, 0] += a00
        H[1, 0] += a01
        H[1, 1] += a11
        H[2, 0] += a02
        H[2, 1] += a12
        H[2, 2] += a22
        g[0] -= b0
        g[1] -= b1
        g[2] -= b2
        if free == 3:
            continue
        m00, m01, m02 = p1 * a02 - p2 * a01, p1 * a12 - p2 * a11, p1 * a22 - p2 * a12
        m10, m11, m12 = p2 * a00 - p0 * a02, p2 * a01 - p0 * a12, p2 * a02 - p0 * a22
        m20, m21, m22 = p0 * a01 - p1 * a00, p0 * a11 - p1 * a01, p0 * a12 - p1 * a02
        H[3, 0] += m00
        H[3, 1] += m01
        H[3, 2] += m02
        H[4, 0] += m10
        H[4, 1] += m11
        H[4, 2] += m12
        H[5, 0] += m20
        H[5, 1] += m21
        H[5, 2] += m22
        H[3, 3] += p1 * m02 - p2 * m01
        H[4, 3] += p1 * m12 - p2 * m11
        H[4, 4] += p2 * m10 - p0 * m12
        H[5, 3] += p1 * m22 - p2 * m21
        H[5, 4] += p2 * m20 - p0 * m22
        H[5, 5] += p0 * m21 - p1 * m20
        g[3] -= p1 * b2 - p2 * b1
        g[4] -= p2 * b0 - p0 * b2
        g[5] -= p0 * b1 - p1 * b0
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _add_pair(r0: float, r1: float, W: F64, i: int, J: F64, counts: bool, robust: bool, H: F64, g: F64) -> tuple[float, float]:
    """χ² and cost of term i with residuals r, derivatives J (2, 6) and weights W (·, 2, 2), added to the normal equations if it `counts`; χ² is inf,
    and nothing is added, where it is none."""
    w00, w01, w11 = W[i, 0, 0], W[i, 0, 1], W[i, 1, 1]
    e0, e1 = w00 * r0 + w01 * r1, w01 * r0 + w11 * r1
    chi2 = e0 * r0 + e1 * r1
    if not chi2 < np.inf:  # NaN, or a noise that has no inverse
        return np.inf, 0.0
    if not counts:
        return chi2, 0.0
    w, cost = _huber(chi2, CHI2_2, robust)
    for a in range(6):
        x, y = w * (w00 * J[0, a] + w01 * J[1, a]), w * (w01 * J[0, a] + w11 * J[1, a])
        g[a] += w * (e0 * J[0, a] + e1 * J[1, a])
        for b in range(a + 1):
            H[a, b] += x * J[0, b] + y * J[1, b]
    return chi2, cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_lines(
    R: F64, t: F64, camera: F64, terms: LineTerms, W: F64, V: F64, flags: U8, robust: bool, H: F64, g: F64, chi2: F64, depth_chi2: F64
) -> float:
    """All lines: the distances of both ends from the segment in the image (`line_row`) and from the 3D one in depth (`line_depth_row`)."""
    cost = 0.0
    p, r, J, m = np.empty((2, 3)), np.empty(2), np.empty((2, 6)), np.empty(3)
    for i in range(len(terms.endpoints_m)):
        for k in range(2):
            x, y, z = terms.endpoints_m[i, k, 0] - t[0], terms.endpoints_m[i, k, 1] - t[1], terms.endpoints_m[i, k, 2] - t[2]
            for a in range(3):
                p[k, a] = R[0, a] * x + R[1, a] * y + R[2, a] * z
        chi2[i], depth_chi2[i] = np.inf, np.inf
        if not (p[0, 2] > NEAR_M and p[1, 2] > NEAR_M):
            cost += BEHIND if flags[i] else 0.0
            continue
        u, v = terms.endpoints_px[i, 0, 0], terms.endpoints_px[i, 0, 1]
        du, dv = terms.endpoints_px[i, 1, 0] - u, terms.endpoints_px[i, 1, 1] - v
        length = max(np.sqrt(du * du + dv * dv), 1e-9)
        nu, nv = -dv / length, du / length
        for k in range(2):
            iz = 1.0 / p[k, 2]
            r[k] = nu * (camera[0] * p[k, 0] * iz + camera[2] - u) + nv * (camera[1] * p[k, 1] * iz + camera[3] - v)
            d0, d1 = nu * camera[0] * iz, nv * camera[1] * iz
            _chain(d0, d1, -(d0 * p[k, 0] + d1 * p[k, 1]) * iz, p, k, J)
        chi2[i], share = _add_pair(r[0], r[1], W, i, J, flags[i] != OUTLIER, robust, H, g)
        cost += share
        if chi2[i] == np.inf:
            cost += BEHIND if flags[i] else 0.0
        elif depth_direction(terms.observed_m[i], m):
            for k in range(2):
                r[k] = 0.0
                for a in range(3):
                    r[k] += m[a] * (p[k, a] - terms.observed_m[i, 0, a])
                _chain(m[0], m[1], m[2], p, k, J)
            depth_chi2[i], share = _add_pair(r[0], r[1], V, i, J, flags[i] == INLIER, robust, H, g)
            cost += share
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _chain(a: float, b: float, c: float, p: F64, k: int, J: F64) -> None:
    """Row k of J (·, 6) from the derivative (a, b, c) with respect to the camera-frame point in row k of p, as `chain_point`."""
    J[k, 0], J[k, 1], J[k, 2] = -a, -b, -c
    J[k, 3], J[k, 4], J[k, 5] = b * p[k, 2] - c * p[k, 1], c * p[k, 0] - a * p[k, 2], a * p[k, 1] - b * p[k, 0]


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def gate(rows: int) -> float:
    """95 % of χ² with 1, 2 or 3 degrees of freedom."""
    return CHI2_3 if rows == 3 else (CHI2_2 if rows == 2 else CHI2_1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_planes(R: F64, t: F64, terms: PlaneTerms, W: F64, flags: U8, H: F64, g: F64, chi2: F64) -> float:
    cost = 0.0
    r, e, J, B = np.empty(3), np.empty(3), np.empty((3, 6)), np.empty((3, 2))
    for i in range(len(terms.kinds)):
        basis(terms.observed[i], B)
        rows = plane_rows(terms.kinds[i], R, t, terms.coefficients[i], terms.observed[i], B, r, J)
        chi2[i] = _chi2(r, W[i], rows, e)
        if not chi2[i] < np.inf:
            chi2[i] = np.inf
            cost += BEHIND if flags[i] else 0.0
        elif flags[i]:
            cost += _add(chi2[i], e, J, rows, W[i], gate(rows), True, 0 if rows == 3 else 3, H, g)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def linearise(
    R: F64,
    t: F64,
    camera: F64,
    points: PointTerms,
    lines: LineTerms,
    planes: PlaneTerms,
    weights: Weights,
    flags: Flags,
    robust: bool,
    free: int,
    H: F64,
    g: F64,
    chi2: Chi2,
) -> float:
    """Normal equations (H lower triangle of (6, 6), g (6,)) of all terms but the outliers, and the χ² of every term; returns the cost. With 3
    `free` unknowns only what concerns the position is whole."""
    for a in range(6):
        g[a] = 0.0
        for b in range(6):
            H[a, b] = 0.0
    cost = _add_points(R, t, camera, points, weights.points, flags.points, robust, free, H, g, chi2.points)
    cost += _add_lines(R, t, camera, lines, weights.lines, weights.line_depths, flags.lines, robust, H, g, chi2.lines, chi2.line_depths)
    return cost + _add_planes(R, t, planes, weights.planes, flags.planes, H, g, chi2.planes)
