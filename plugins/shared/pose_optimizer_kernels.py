"""Kernels of `pose_optimizer.py`: robust Levenberg–Marquardt for one camera pose against points, lines and planes (eqs. 2–8).

Minimises `Σ ρ(rᵀ W r) + ‖log(T_prior⁻¹ T)‖²` over the pose `R, t` of `T_world_camera`. The parameters are `xi = (rho, phi)` in
`T_world_camera · Exp(xi)`; `camera` is (fx, fy, cx, cy). Residuals, Jacobians and information matrices are those of `residuals_kernels`. In order:
robust normal equations, the prior, damping, retraction, outliers, covariance, and `solve`, which runs them.

Helpers of single terms are inlined (`forceinline`): passing an array costs numba seven numbers and a reference count, as much as the helper itself.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import add_triangle, add_triple, copy_matrix, inverse_positive, solve_positive, tangent_columns
from trihedron.pipeline.core.types import F64, I32, U8
from trihedron.plugins.shared.lie_kernels import exp_so3, log_so3
from trihedron.plugins.shared.residuals_kernels import (
    NEAR_M,
    LineTerms,
    PlaneTerms,
    PointTerms,
    Weights,
    depth_direction,
    fill_weights,
    plane_residual,
    pose_jacobian_row,
    residual_dimension,
)

CHI2_95 = (0.0, 3.841, 5.991, 7.815)  # 95 % gates of χ² by degrees of freedom, 1 to 3: the one table of this threshold
BEHIND = 10.0 * CHI2_95[3]  # cost of a term that cannot be projected: as bad as a gross outlier, so that no step profits from it
OUTLIER, INLIER, NO_DEPTH = 0, 1, 2  # flags of a term; NO_DEPTH is a line of which only the image part fits


class Flags(NamedTuple):
    """OUTLIER, INLIER or NO_DEPTH per term."""

    points: U8
    lines: U8
    planes: U8


class Groups(NamedTuple):
    """Number of the group that each term belongs to."""

    points: I32
    lines: I32
    planes: I32


class Chi2(NamedTuple):
    """Squared Mahalanobis norm of each residual; inf when it cannot be projected (a line without depth has inf in `line_depths`)."""

    points: F64
    lines: F64
    line_depths: F64
    planes: F64


# Robust weights and normal equations.


@kernel(forceinline=True)
def _chi2(r: F64, W: F64, rows: int, e: F64) -> float:
    """`rᵀ W r`, with `e = W r` left for `_add`."""
    chi2 = 0.0
    for i in range(rows):
        e[i] = 0.0
        for j in range(rows):
            e[i] += W[i, j] * r[j]
        chi2 += e[i] * r[i]
    return chi2


@kernel(forceinline=True)
def _huber(chi2: float, limit: float, robust: bool) -> tuple[float, float]:
    """Huber's weight and cost of a term beyond the gate `limit` on its χ²; 1 and χ² when not `robust`."""
    if robust and chi2 > limit:
        return np.sqrt(limit / chi2), 2.0 * np.sqrt(limit * chi2) - limit
    return 1.0, chi2


@kernel(forceinline=True)
def _add(chi2: float, e: F64, J: F64, rows: int, W: F64, limit: float, robust: bool, first: int, H: F64, g: F64) -> float:
    """Add one term to the normal equations `H dx = -g` with Huber's weight, skipping its Jacobian's zero columns before the `first`; returns its
    cost."""
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


@kernel
def _add_points(R: F64, t: F64, camera: F64, terms: PointTerms, W: F64, flags: U8, robust: bool, free: int, H: F64, g: F64, chi2: F64) -> float:
    """Add all points; `point_residual` in scalars, since points are most of the work. Returns the cost.

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
        w, share = _huber(value, CHI2_95[3] if w22 > 0.0 else CHI2_95[2], robust)
        cost += share
        a00, a11, a01 = w * d00 * d00 * w00, w * d11 * d11 * w11, w * d00 * d11 * w01
        a02 = w * d00 * (w00 * d02 + w01 * d12 + w02 * d22)
        a12 = w * d11 * (w01 * d02 + w11 * d12 + w12 * d22)
        a22 = w * (d02 * d02 * w00 + d12 * d12 * w11 + d22 * d22 * w22 + 2.0 * (d02 * d12 * w01 + d02 * d22 * w02 + d12 * d22 * w12))
        b0, b1, b2 = w * d00 * e0, w * d11 * e1, w * (d02 * e0 + d12 * e1 + d22 * e2)
        add_triangle(H, 0, a00, a01, a11, a02, a12, a22)
        add_triple(g, 0, -b0, -b1, -b2)
        if free == 3:
            continue
        m00, m01, m02 = p1 * a02 - p2 * a01, p1 * a12 - p2 * a11, p1 * a22 - p2 * a12
        m10, m11, m12 = p2 * a00 - p0 * a02, p2 * a01 - p0 * a12, p2 * a02 - p0 * a22
        m20, m21, m22 = p0 * a01 - p1 * a00, p0 * a11 - p1 * a01, p0 * a12 - p1 * a02
        add_triple(H[3], 0, m00, m01, m02)
        add_triple(H[4], 0, m10, m11, m12)
        add_triple(H[5], 0, m20, m21, m22)
        add_triangle(
            H, 3, p1 * m02 - p2 * m01, p1 * m12 - p2 * m11, p2 * m10 - p0 * m12, p1 * m22 - p2 * m21, p2 * m20 - p0 * m22, p0 * m21 - p1 * m20
        )
        add_triple(g, 3, p2 * b1 - p1 * b2, p0 * b2 - p2 * b0, p1 * b0 - p0 * b1)
    return cost


@kernel(forceinline=True)
def _add_pair(r0: float, r1: float, W: F64, i: int, J: F64, counts: bool, robust: bool, H: F64, g: F64) -> tuple[float, float]:
    """Add the residuals (r0, r1) of line i with Jacobian J (2, 6) and information W (·, 2, 2), unless it is an outlier (`counts` False).

    Returns χ² and cost; χ² is inf, and nothing is added, where the residual has no information."""
    w00, w01, w11 = W[i, 0, 0], W[i, 0, 1], W[i, 1, 1]
    e0, e1 = w00 * r0 + w01 * r1, w01 * r0 + w11 * r1
    chi2 = e0 * r0 + e1 * r1
    if not chi2 < np.inf:  # NaN, or a noise that has no inverse
        return np.inf, 0.0
    if not counts:
        return chi2, 0.0
    w, cost = _huber(chi2, CHI2_95[2], robust)
    for a in range(6):
        x, y = w * (w00 * J[0, a] + w01 * J[1, a]), w * (w01 * J[0, a] + w11 * J[1, a])
        g[a] += w * (e0 * J[0, a] + e1 * J[1, a])
        for b in range(a + 1):
            H[a, b] += x * J[0, b] + y * J[1, b]
    return chi2, cost


@kernel
def _add_lines(
    R: F64, t: F64, camera: F64, terms: LineTerms, W: F64, V: F64, flags: U8, robust: bool, H: F64, g: F64, chi2: F64, depth_chi2: F64
) -> float:
    """Add all lines: both ends in the image (`line_residual`) and in depth (`line_depth_residual`). Returns the cost."""
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
            pose_jacobian_row(d0, d1, -(d0 * p[k, 0] + d1 * p[k, 1]) * iz, p, k, J)
        chi2[i], share = _add_pair(r[0], r[1], W, i, J, flags[i] != OUTLIER, robust, H, g)
        cost += share
        if chi2[i] == np.inf:
            cost += BEHIND if flags[i] else 0.0
        elif depth_direction(terms.observed_m[i], m):
            for k in range(2):
                r[k] = 0.0
                for a in range(3):
                    r[k] += m[a] * (p[k, a] - terms.observed_m[i, 0, a])
                pose_jacobian_row(m[0], m[1], m[2], p, k, J)
            depth_chi2[i], share = _add_pair(r[0], r[1], V, i, J, flags[i] == INLIER, robust, H, g)
            cost += share
    return cost


@kernel
def _add_planes(R: F64, t: F64, terms: PlaneTerms, W: F64, flags: U8, H: F64, g: F64, chi2: F64) -> float:
    """Add all plane pairs, always with Huber's weight. Returns the cost."""
    cost = 0.0
    r, e, J, B = np.empty(3), np.empty(3), np.empty((3, 6)), np.empty((3, 2))
    for i in range(len(terms.kinds)):
        tangent_columns(terms.observed[i], B)
        rows = plane_residual(terms.kinds[i], R, t, terms.coefficients[i], terms.observed[i], B, r, J)
        chi2[i] = _chi2(r, W[i], rows, e)
        if not chi2[i] < np.inf:
            chi2[i] = np.inf
            cost += BEHIND if flags[i] else 0.0
        elif flags[i]:
            cost += _add(chi2[i], e, J, rows, W[i], CHI2_95[rows], True, 0 if rows == 3 else 3, H, g)
    return cost


@kernel
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
    """Fill the normal equations (H lower triangle of (6, 6), g (6,)) of all terms but the outliers, and the χ² of every term; return the cost.

    With 3 `free` parameters only the block of the position is complete."""
    H[:], g[:] = 0.0, 0.0
    cost = _add_points(R, t, camera, points, weights.points, flags.points, robust, free, H, g, chi2.points)
    cost += _add_lines(R, t, camera, lines, weights.lines, weights.line_depths, flags.lines, robust, H, g, chi2.lines, chi2.line_depths)
    return cost + _add_planes(R, t, planes, weights.planes, flags.planes, H, g, chi2.planes)


@kernel
def add_scores(
    R: F64, t: F64, camera: F64, points: PointTerms, lines: LineTerms, planes: PlaneTerms, flags: Flags, groups: Groups, H: F64, g: F64
) -> None:
    """Add the normal equations of each term but the outliers to those of its group: H (k, 6, 6), lower triangles, and g (k, 6)."""
    n, m, p = len(points.positions_m), len(lines.endpoints_m), len(planes.kinds)
    weights = Weights(np.empty((n, 3, 3)), np.empty((m, 2, 2)), np.empty((m, 2, 2)), np.empty((p, 3, 3)))
    chi2 = Chi2(np.empty(n), np.empty(m), np.empty(m), np.empty(p))
    fill_weights(R, t, camera, points, lines, planes, weights)
    robust, free = np.bool_(False), np.int64(6)  # as literals, numba would compile what takes them anew
    for i in range(n):
        a, b, k = i, i + 1, groups.points[i]
        one = PointTerms(
            points.positions_m[a:b], points.covariance_m2[a:b], points.pixels[a:b], points.depth_m[a:b], points.sigma_px[a:b], points.sigma_m[a:b]
        )
        _add_points(R, t, camera, one, weights.points[a:b], flags.points[a:b], robust, free, H[k], g[k], chi2.points[a:b])
    for i in range(m):
        a, b, k = i, i + 1, groups.lines[i]
        line = LineTerms(
            lines.endpoints_m[a:b], lines.covariance_m2[a:b], lines.endpoints_px[a:b], lines.sigma_px[a:b], lines.observed_m[a:b],
            lines.observed_covariance_m2[a:b],
        )  # fmt: skip
        W, V = weights.lines[a:b], weights.line_depths[a:b]
        _add_lines(R, t, camera, line, W, V, flags.lines[a:b], robust, H[k], g[k], chi2.lines[a:b], chi2.line_depths[a:b])
    for i in range(p):
        a, b, k = i, i + 1, groups.planes[i]
        plane = PlaneTerms(planes.kinds[a:b], planes.coefficients[a:b], planes.covariance[a:b], planes.observed[a:b], planes.observed_covariance[a:b])
        _add_planes(R, t, plane, weights.planes[a:b], flags.planes[a:b], H[k], g[k], chi2.planes[a:b])


# The Gaussian prior. It holds every direction that the data do not observe, so that any set of terms, even one plane, can be solved.


@kernel
def add_prior(R: F64, t: F64, R_prior: F64, t_prior: F64, prior: F64, H: F64, g: F64) -> float:
    """Add the Gaussian prior, information `prior` (6, 6) of xi about R_prior, t_prior, to H (lower triangle) and g; returns its cost."""
    delta, r, J, e = np.zeros((3, 3)), np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    for i in range(3):
        for k in range(3):
            r[i] += R_prior[k, i] * (t[k] - t_prior[k])
            for j in range(3):
                delta[i, j] += R_prior[k, i] * R[k, j]
    r[3], r[4], r[5] = log_so3(delta)
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


# Damping and retraction.


@kernel
def damped_step(H: F64, g: F64, damping: float, free: int, dx: F64) -> None:
    """Solve `(H + damping · diag H) dx = -g` for the first `free` parameters by Cholesky; dx (6,) is zero if H is not positive definite."""
    A, b = np.empty((free, free)), np.empty(free)
    for i in range(6):
        dx[i] = 0.0
    for i in range(free):
        b[i] = -g[i]
        for j in range(i + 1):
            A[i, j] = H[i, j] * (1.0 + damping if i == j else 1.0)
    solve_positive(A, b, dx)


@kernel
def step_norm2(H: F64, dx: F64) -> float:
    """Squared Mahalanobis norm `dxᵀ H dx` of a step (H lower triangle)."""
    total = 0.0
    for a in range(6):
        for b in range(a + 1):
            total += H[a, b] * dx[a] * dx[b] * (1.0 if a == b else 2.0)
    return total


@kernel
def retract_pose(R: F64, t: F64, dx: F64, R_new: F64, t_new: F64) -> None:
    """Move the pose R, t by a step dx = (rho, phi) into R_new, t_new: `R Exp(phi)`, `t + R rho`, which is `T · Exp(xi)` to first order."""
    E = exp_so3(dx[3], dx[4], dx[5])
    for i in range(3):
        t_new[i] = t[i] + R[i, 0] * dx[0] + R[i, 1] * dx[1] + R[i, 2] * dx[2]
        for j in range(3):
            R_new[i, j] = R[i, 0] * E[0, j] + R[i, 1] * E[1, j] + R[i, 2] * E[2, j]


# Outliers and covariance.


@kernel
def _classify(points: PointTerms, planes: PlaneTerms, chi2: Chi2, flags: Flags, slack: float) -> None:
    """Classify inliers and outliers by the 95 % gates of χ²; those of planes are multiplied by `slack`."""
    for i in range(len(chi2.points)):
        limit = CHI2_95[3] if np.isfinite(points.depth_m[i]) else CHI2_95[2]
        flags.points[i] = INLIER if chi2.points[i] <= limit else OUTLIER
    for i in range(len(chi2.lines)):
        flags.lines[i] = OUTLIER
        if chi2.lines[i] <= CHI2_95[2]:
            flags.lines[i] = INLIER if chi2.line_depths[i] <= CHI2_95[2] else NO_DEPTH
    for i in range(len(chi2.planes)):
        flags.planes[i] = INLIER if chi2.planes[i] <= slack * CHI2_95[residual_dimension(planes.kinds[i])] else OUTLIER


@kernel
def _residual_count(points: PointTerms, planes: PlaneTerms, flags: Flags) -> int:
    """Number of residuals of the inliers."""
    rows = 0
    for i in range(len(flags.points)):
        if flags.points[i]:
            rows += 3 if np.isfinite(points.depth_m[i]) else 2
    for i in range(len(flags.lines)):
        if flags.lines[i]:
            rows += 4 if flags.lines[i] == INLIER else 2
    for i in range(len(flags.planes)):
        if flags.planes[i]:
            rows += residual_dimension(planes.kinds[i])
    return rows


@kernel
def gate_efficiency(rows: int, unknowns: int) -> float:
    """Share of the information that remains when terms are selected by a hard 95 % gate on their own residuals.

    The mean of samples truncated at the gate c has a variance of 1 / F_{k+2}(c), F_k being the distribution of χ², where counting the F_k(c)
    retained samples promises 1 / F_k(c); with few redundant rows the residuals are smaller than the noise and the gate rejects less. The tests check
    the NEES."""
    if rows <= unknowns:
        return 1.0
    half = 0.5 * CHI2_95[3] / (1.0 - unknowns / rows)
    tail = math.sqrt(half / math.pi) * math.exp(-half)
    retained = math.erf(math.sqrt(half)) - 2.0 * tail  # F_3, the incomplete gamma function of 3/2; that of 5/2 follows by its recurrence
    return (retained - 4.0 / 3.0 * half * tail) / retained


@kernel
def _marginal_covariance(data: F64, share: float, prior: F64, free: int) -> tuple[F64, F64, bool]:
    """Covariance of the `free` parameters from a share of the data's information (lower triangle) plus the prior's.

    Also returns that share of the data's information, and True when it exceeds the prior's in every direction (all directions are observable)."""
    information, total, more = np.empty((free, free)), np.empty((free, free)), np.empty((free, free))
    for i in range(free):
        for j in range(i + 1):
            information[i, j] = information[j, i] = share * data[i, j]
            total[i, j], more[i, j] = information[i, j] + prior[i, j], information[i, j] - prior[i, j]
    covariance = inverse_positive(total)
    for i in range(free):
        for j in range(i):
            covariance[i, j] = covariance[j, i] = 0.5 * (covariance[i, j] + covariance[j, i])
    return covariance, information, solve_positive(more, np.zeros(free), np.empty(free))


# The optimiser.

ROUNDS, ITERATIONS, ROBUST_ROUNDS = 4, 10, 2  # as ORB-SLAM2 optimises a pose; Huber only in the first rounds
CONVERGED = 1e-3  # squared Mahalanobis norm of a step below which a round has converged
MAX_DAMPING = 1e10


@kernel
def solve(
    poses: F64, prior: F64, camera: F64, points: PointTerms, lines: LineTerms, planes: PlaneTerms, flags: Flags, free: int, rounds: int, slack: float
) -> tuple[F64, F64, F64, F64, float, bool]:
    """Run the rounds of Levenberg–Marquardt from poses[0]; poses[1] (4, 4) is the prior's mean. Changes `flags`.

    Each round linearises the weights once, iterates, and classifies the outliers anew. Every evaluation is the one call of `linearise`; a step below
    CONVERGED is taken without another evaluation. A last pass without a step collects the information of the final inliers. With 0 rounds all terms
    are classified at the first pose. Returns the pose, its covariance, the data's information, the next step (6,), the cost, and True when all
    directions are observable."""
    n, m, p = len(points.positions_m), len(lines.endpoints_m), len(planes.kinds)
    weights = Weights(np.empty((n, 3, 3)), np.empty((m, 2, 2)), np.empty((m, 2, 2)), np.empty((p, 3, 3)))
    chi2 = Chi2(np.empty(n), np.empty(m), np.empty(m), np.empty(p))
    R, t = poses[0, :3, :3].copy(), poses[0, :3, 3].copy()
    R_prior, t_prior = poses[1, :3, :3].copy(), poses[1, :3, 3].copy()
    R_new, t_new = np.empty((3, 3)), np.empty(3)
    H, g, dx = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    data, data_g, trial_H, trial_g = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6)), np.zeros(6)
    cost = 0.0
    for pass_index in range(rounds + 1):
        cost, damping = np.inf, 1e-6
        _copy(R, t, R_new, t_new)
        fill_weights(R, t, camera, points, lines, planes, weights)
        for trial in range(ITERATIONS + 1):
            new = linearise(R_new, t_new, camera, points, lines, planes, weights, flags, pass_index < ROBUST_ROUNDS, free, trial_H, trial_g, chi2)
            _copy(trial_H, trial_g, data, data_g)
            new += add_prior(R_new, t_new, R_prior, t_prior, prior, trial_H, trial_g)
            accepted = trial == 0 or new <= cost
            if accepted:
                cost = new
                _copy(R_new, t_new, R, t)
                _copy(trial_H, trial_g, H, g)
                damping = max(0.1 * damping, 1e-9)
            else:
                damping = max(10.0 * damping, 1e-3)
            if pass_index == rounds or damping > MAX_DAMPING:
                break
            damped_step(H, g, damping, free, dx)
            retract_pose(R, t, dx, R_new, t_new)
            length = step_norm2(H, dx)
            if not length > CONVERGED:
                if accepted and length >= 0.0:
                    _copy(R_new, t_new, R, t)
                break
        if pass_index < rounds or rounds == 0:
            _classify(points, planes, chi2, flags, slack)
    damped_step(H, g, 0.0, free, dx)
    share = gate_efficiency(_residual_count(points, planes, flags), free) if rounds else 1.0
    covariance, information, complete = _marginal_covariance(data, share, prior, free)
    T = np.eye(4)
    copy_matrix(R, T)
    for i in range(3):
        T[i, 3] = t[i]
    return T, covariance, information, dx, cost, complete


@kernel
def _copy(A: F64, a: F64, B: F64, b: F64) -> None:
    """Copy a matrix (n, n) and a vector (n,), a pose or normal equations, into B and b."""
    copy_matrix(A, B)
    for i in range(len(a)):
        b[i] = a[i]
