"""The numba loops of the pose solver: normal equations of point, line and plane terms."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.types import F64, U8
from trihedron.plugins.numerics.motion.pose_noise import Weights
from trihedron.plugins.numerics.motion.pose_terms import (
    NEAR_M,
    LineTerms,
    PlaneTerms,
    PointTerms,
    basis,
    chain_point,
    depth_direction,
    line_depth_row,
    line_row,
    plane_rows,
    point_rows,
    to_camera,
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _chi2(r: F64, W: F64, rows: int, e: F64) -> float:
    """rᵀ W r, with `e = W r` left for `_add`."""
    chi2 = 0.0
    for i in range(rows):
        e[i] = 0.0
        for j in range(rows):
            e[i] += W[i, j] * r[j]
        chi2 += e[i] * r[i]
    return chi2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _huber(chi2: float, limit: float, robust: bool) -> tuple[float, float]:
    """Weight and cost of a term whose χ² may lie beyond the limit."""
    if robust and chi2 > limit:
        return np.sqrt(limit / chi2), 2.0 * np.sqrt(limit * chi2) - limit
    return 1.0, chi2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add(chi2: float, e: F64, J: F64, rows: int, W: F64, limit: float, robust: bool, H: F64, g: F64) -> float:
    """Add one term to the normal equations `H dx = -g` (Huber beyond `limit` when robust); returns its cost."""
    w, cost = _huber(chi2, limit, robust)
    row = np.empty(6)
    for i in range(rows):
        for b in range(6):
            row[b] = 0.0
        for j in range(rows):
            for b in range(6):
                row[b] += w * W[i, j] * J[j, b]
        for a in range(6):
            g[a] += w * e[i] * J[i, a]
            for b in range(a + 1):
                H[a, b] += J[i, a] * row[b]
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_point(p: F64, D: F64, W: F64, e: F64, w: float, A: F64, M: F64, H: F64, g: F64) -> None:
    """Add a point's term with weight w: with A = DᵀWD, b = DᵀWr and P = [p]×, J = (-D, DP) gives the blocks A, PA, -PAP and -b, -p × b.

    A and M are scratch (3, 3). Written out because points are most of the work."""
    a, b, x, y, z = w * D[0, 0], w * D[1, 1], D[0, 2], D[1, 2], D[2, 2]
    A[0, 0] = a * D[0, 0] * W[0, 0]
    A[1, 1] = b * D[1, 1] * W[1, 1]
    A[0, 1] = A[1, 0] = a * D[1, 1] * W[0, 1]
    A[0, 2] = A[2, 0] = a * (W[0, 0] * x + W[0, 1] * y + W[0, 2] * z)
    A[1, 2] = A[2, 1] = b * (W[0, 1] * x + W[1, 1] * y + W[1, 2] * z)
    A[2, 2] = w * (x * x * W[0, 0] + y * y * W[1, 1] + z * z * W[2, 2] + 2.0 * (x * y * W[0, 1] + x * z * W[0, 2] + y * z * W[1, 2]))
    b0, b1, b2 = a * e[0], b * e[1], w * (x * e[0] + y * e[1] + z * e[2])
    for j in range(3):
        M[0, j] = p[1] * A[2, j] - p[2] * A[1, j]
        M[1, j] = p[2] * A[0, j] - p[0] * A[2, j]
        M[2, j] = p[0] * A[1, j] - p[1] * A[0, j]
        for i in range(3):
            H[i, j] += A[i, j]
            H[3 + i, j] += M[i, j]
    for i in range(3):
        H[3 + i, 3] += p[1] * M[i, 2] - p[2] * M[i, 1]
        H[3 + i, 4] += p[2] * M[i, 0] - p[0] * M[i, 2]
        H[3 + i, 5] += p[0] * M[i, 1] - p[1] * M[i, 0]
    g[0] -= b0
    g[1] -= b1
    g[2] -= b2
    g[3] -= p[1] * b2 - p[2] * b1
    g[4] -= p[2] * b0 - p[0] * b2
    g[5] -= p[0] * b1 - p[1] * b0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_points(R: F64, t: F64, camera: F64, terms: PointTerms, W: F64, flags: U8, robust: bool, H: F64, g: F64, chi2: F64) -> float:
    cost = 0.0
    p, r, e, D, A, M = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(terms.positions_m)):
        to_camera(R, t, terms.positions_m[i], p)
        if not point_rows(p, terms.pixels[i], terms.depth_m[i], camera, r, D):
            chi2[i] = np.inf
            cost += BEHIND if flags[i] else 0.0
            continue
        for k in range(3):
            e[k] = W[i, k, 0] * r[0] + W[i, k, 1] * r[1] + W[i, k, 2] * r[2]
        chi2[i] = e[0] * r[0] + e[1] * r[1] + e[2] * r[2]
        if not chi2[i] < np.inf:  # NaN, or a noise that has no inverse
            chi2[i] = np.inf
            cost += BEHIND if flags[i] else 0.0
        elif flags[i]:
            w, share = _huber(chi2[i], CHI2_3 if W[i, 2, 2] > 0.0 else CHI2_2, robust)
            cost += share
            _add_point(p, D, W[i], e, w, A, M, H, g)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_lines(
    R: F64, t: F64, camera: F64, terms: LineTerms, W: F64, V: F64, flags: U8, robust: bool, H: F64, g: F64, chi2: F64, depth_chi2: F64
) -> float:
    cost = 0.0
    p, r, e, D, J, m = np.empty((2, 3)), np.empty(3), np.empty(3), np.empty((2, 3)), np.empty((2, 6)), np.empty(3)
    for i in range(len(terms.endpoints_m)):
        to_camera(R, t, terms.endpoints_m[i, 0], p[0])
        to_camera(R, t, terms.endpoints_m[i, 1], p[1])
        chi2[i], depth_chi2[i] = np.inf, np.inf
        if not (p[0, 2] > NEAR_M and p[1, 2] > NEAR_M):
            cost += BEHIND if flags[i] else 0.0
            continue
        for k in range(2):
            r[k] = line_row(p[k], terms.endpoints_px[i], camera, D[k])[0]
            chain_point(D[k : k + 1], 1, p[k], J[k : k + 1])
        chi2[i] = _chi2(r, W[i], 2, e)
        if not chi2[i] < np.inf:
            chi2[i] = np.inf
            cost += BEHIND if flags[i] else 0.0
            continue
        if flags[i]:
            cost += _add(chi2[i], e, J, 2, W[i], CHI2_2, robust, H, g)
        if depth_direction(terms.observed_m[i], m):
            for k in range(2):
                r[k] = line_depth_row(p[k], terms.observed_m[i], m)[0]
                D[k] = m
                chain_point(D[k : k + 1], 1, p[k], J[k : k + 1])
            depth_chi2[i] = _chi2(r, V[i], 2, e)
            if not depth_chi2[i] < np.inf:
                depth_chi2[i] = np.inf
            elif flags[i] == INLIER:
                cost += _add(depth_chi2[i], e, J, 2, V[i], CHI2_2, robust, H, g)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def gate(rows: int) -> float:
    """95 % of χ² with 1, 2 or 3 degrees of freedom."""
    return CHI2_3 if rows == 3 else (CHI2_2 if rows == 2 else CHI2_1)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_planes(R: F64, t: F64, terms: PlaneTerms, W: F64, flags: U8, H: F64, g: F64, chi2: F64) -> float:
    cost = 0.0
    r, e, J, B = np.empty(3), np.empty(3), np.empty((3, 6)), np.empty((3, 2))
    for i in range(len(terms.kinds)):
        basis(terms.observed[i, :3], B)
        rows = plane_rows(terms.kinds[i], R, t, terms.coefficients[i], terms.observed[i], B, r, J)
        chi2[i] = _chi2(r, W[i], rows, e)
        if not chi2[i] < np.inf:
            chi2[i] = np.inf
            cost += BEHIND if flags[i] else 0.0
        elif flags[i]:
            cost += _add(chi2[i], e, J, rows, W[i], gate(rows), True, H, g)
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
    H: F64,
    g: F64,
    chi2: Chi2,
) -> float:
    """Normal equations (H lower triangle of (6, 6), g (6,)) of all terms but the outliers, and the χ² of every term; returns the cost."""
    H[:], g[:] = 0.0, 0.0
    cost = _add_points(R, t, camera, points, weights.points, flags.points, robust, H, g, chi2.points)
    cost += _add_lines(R, t, camera, lines, weights.lines, weights.line_depths, flags.lines, robust, H, g, chi2.lines, chi2.line_depths)
    return cost + _add_planes(R, t, planes, weights.planes, flags.planes, H, g, chi2.planes)
