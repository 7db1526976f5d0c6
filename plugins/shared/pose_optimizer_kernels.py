"""Kernels of `pose_optimizer.py`: robust Levenberg–Marquardt for one camera pose against points, lines and planes (eqs. 2–8).

Minimises `Σ ρ(rᵀ W r) + ‖log(T_prior⁻¹ T)‖²` over the pose `R, t` of `T_world_camera`. The parameters are `xi = (rho, phi)` in
`T_world_camera · Exp(xi)`; `camera` is (fx, fy, cx, cy). In order: residuals and Jacobians, their information matrices, robust normal equations,
the prior, damping, retraction, outliers, covariance, and `solve`, which runs them.

Helpers of single terms are inlined (`forceinline`): passing an array costs numba seven numbers and a reference count, as much as the helper itself.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import add_triangle, add_triple, inverse_positive, solve_positive, tangent_columns
from trihedron.pipeline.core.types import F64, I32, U8
from trihedron.plugins.shared.lie_kernels import exp_so3, log_so3

# The parameters of the problem: world landmarks and their observations.

SAME, PARALLEL, PERPENDICULAR = 0, 1, 2  # kinds of plane terms
NEAR_M = 0.05  # a point nearer than this to the image plane is not projected
CHI2_95 = (0.0, 3.841, 5.991, 7.815)  # 95 % gates of χ² by degrees of freedom, 1 to 3: the one table of this threshold
BEHIND = 10.0 * CHI2_95[3]  # cost of a term that cannot be projected: as bad as a gross outlier, so that no step profits from it
OUTLIER, INLIER, NO_DEPTH = 0, 1, 2  # flags of a term; NO_DEPTH is a line of which only the image part fits


class PointTerms(NamedTuple):
    """n world points and their observations; `depth_m` is NaN where only the pixel was measured."""

    positions_m: F64  # (n, 3) world
    covariance_m2: F64  # (n, 3, 3) world, of the positions
    pixels: F64  # (n, 2)
    depth_m: F64  # (n,)
    sigma_px: F64  # (n,)
    sigma_m: F64  # (n,) of the depth


class LineTerms(NamedTuple):
    """m world lines by two points each, and the observed segments; `observed_m` is NaN where only the image was measured."""

    endpoints_m: F64  # (m, 2, 3) world
    covariance_m2: F64  # (m, 2, 3, 3) world
    endpoints_px: F64  # (m, 2, 2)
    sigma_px: F64  # (m,) of an end point across the segment
    observed_m: F64  # (m, 2, 3) camera
    observed_covariance_m2: F64  # (m, 2, 3, 3) camera


class PlaneTerms(NamedTuple):
    """p pairs of a world plane and an observed one. Covariances are of (a, b, d), see `types.Planes`."""

    kinds: I32  # (p,) SAME, PARALLEL or PERPENDICULAR
    coefficients: F64  # (p, 4) world
    covariance: F64  # (p, 3, 3)
    observed: F64  # (p, 4) camera
    observed_covariance: F64  # (p, 3, 3)


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


class Weights(NamedTuple):
    """Information matrices of the residuals, held constant during a round."""

    points: F64  # (n, 3, 3)
    lines: F64  # (m, 2, 2) image distances
    line_depths: F64  # (m, 2, 2)
    planes: F64  # (p, 3, 3)


# Residuals and Jacobians.


@kernel(forceinline=True)
def to_camera(R: F64, t: F64, world: F64, out: F64) -> None:
    """`out = Rᵀ (world - t)`: a world point (3,) in the camera frame."""
    x, y, z = world[0] - t[0], world[1] - t[1], world[2] - t[2]
    for k in range(3):
        out[k] = R[0, k] * x + R[1, k] * y + R[2, k] * z


@kernel
def pose_jacobian(D: F64, rows: int, p: F64, J: F64) -> None:
    """Chain the Jacobian D (rows, 3) by the camera-frame point p to J (rows, 6) by xi: `dp/drho = -I`, `dp/dphi = [p]×`."""
    for k in range(rows):
        a, b, c = D[k, 0], D[k, 1], D[k, 2]
        J[k, 0], J[k, 1], J[k, 2] = -a, -b, -c
        J[k, 3] = b * p[2] - c * p[1]
        J[k, 4] = c * p[0] - a * p[2]
        J[k, 5] = a * p[1] - b * p[0]


@kernel(forceinline=True)
def _pose_jacobian_row(a: float, b: float, c: float, p: F64, k: int, J: F64) -> None:
    """`pose_jacobian` of one row (a, b, c) for the camera-frame point in row k of p, into row k of J (·, 6)."""
    J[k, 0], J[k, 1], J[k, 2] = -a, -b, -c
    J[k, 3], J[k, 4], J[k, 5] = b * p[k, 2] - c * p[k, 1], c * p[k, 0] - a * p[k, 2], a * p[k, 1] - b * p[k, 0]


@kernel
def point_residual(p: F64, pixel: F64, depth_m: float, camera: F64, r: F64, D: F64) -> bool:
    """Residual r (3,) of a camera-frame point p and D = dr/dp (3, 3): reprojection (px, eq. 2) and inverse depth (1/m).

    The third row is the stereo-like row of RGB-D SLAM up to the baseline, 0 without depth. False when p is not in front of the camera, or NaN."""
    if not p[2] > NEAR_M:
        return False
    iz = 1.0 / p[2]
    fx, fy = camera[0] * iz, camera[1] * iz
    r[0] = fx * p[0] + camera[2] - pixel[0]
    r[1] = fy * p[1] + camera[3] - pixel[1]
    D[0, 0], D[0, 1], D[0, 2] = fx, 0.0, -fx * p[0] * iz
    D[1, 0], D[1, 1], D[1, 2] = 0.0, fy, -fy * p[1] * iz
    D[2, 0], D[2, 1], D[2, 2], r[2] = 0.0, 0.0, 0.0, 0.0
    if np.isfinite(depth_m):
        r[2] = iz - 1.0 / depth_m
        D[2, 2] = -iz * iz
    return True


@kernel(forceinline=True)
def line_residual(p: F64, segment_px: F64, camera: F64, D: F64) -> tuple[float, float]:
    """Signed distance (px) of the projected camera-frame point p from the line through `segment_px` (2, 2), eqs. 3 and 4.

    Also returns the parameter along the segment (0 = start, 1 = end). D (3,) is dr/dp. The line is normalised by √(a² + b²); p must be in front."""
    iz = 1.0 / p[2]
    u, v = camera[0] * p[0] * iz + camera[2], camera[1] * p[1] * iz + camera[3]
    dx, dy = segment_px[1, 0] - segment_px[0, 0], segment_px[1, 1] - segment_px[0, 1]
    length = max(np.sqrt(dx * dx + dy * dy), 1e-9)
    a, b = -dy / length, dx / length
    x, y = u - segment_px[0, 0], v - segment_px[0, 1]
    D[0], D[1] = a * camera[0] * iz, b * camera[1] * iz
    D[2] = -(D[0] * p[0] + D[1] * p[1]) * iz
    return a * x + b * y, (dx * x + dy * y) / (length * length)


@kernel(forceinline=True)
def depth_direction(observed_m: F64, m: F64) -> bool:
    """Fill m (3,) with the unit normal of an observed 3D segment (2, 3) within its interpretation plane, the plane through the segment and the camera
    centre: the direction that the image does not measure. False when the segment has NaN or points at the camera."""
    o, e = observed_m[0], observed_m[1]
    dx, dy, dz = e[0] - o[0], e[1] - o[1], e[2] - o[2]
    nx, ny, nz = o[1] * e[2] - o[2] * e[1], o[2] * e[0] - o[0] * e[2], o[0] * e[1] - o[1] * e[0]
    m[0], m[1], m[2] = ny * dz - nz * dy, nz * dx - nx * dz, nx * dy - ny * dx
    length = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    if not length > 1e-9:
        return False
    for k in range(3):
        m[k] /= length
    return True


@kernel(forceinline=True)
def line_depth_residual(p: F64, observed_m: F64, m: F64) -> tuple[float, float]:
    """Distance (m) of a camera-frame point p from an observed 3D segment along m, which is also dr/dp, and the parameter along the segment."""
    x, y, z = p[0] - observed_m[0, 0], p[1] - observed_m[0, 1], p[2] - observed_m[0, 2]
    dx, dy, dz = observed_m[1, 0] - observed_m[0, 0], observed_m[1, 1] - observed_m[0, 1], observed_m[1, 2] - observed_m[0, 2]
    return m[0] * x + m[1] * y + m[2] * z, (dx * x + dy * y + dz * z) / max(dx * dx + dy * dy + dz * dz, 1e-12)


@kernel(forceinline=True)
def residual_dimension(kind: int) -> int:
    """Number of residuals of a kind of plane term."""
    return 3 if kind == SAME else (1 if kind == PERPENDICULAR else 2)


@kernel(forceinline=True)
def plane_residual(kind: int, R: F64, t: F64, world: F64, observed: F64, B: F64, r: F64, J: F64) -> int:
    """Residual r (3,) of a plane pair (eqs. 6 and 8) and J (3, 6) by xi; returns the number of rows. B is the tangent basis of the observed normal.

    SAME: the predicted normal in the tangent plane of the observed one, and d (3 rows; regular at every normal, unlike azimuth and elevation, eq. 5).
    PARALLEL: the tangent rows alone, for either orientation. PERPENDICULAR: the dot product of the normals."""
    n0 = R[0, 0] * world[0] + R[1, 0] * world[1] + R[2, 0] * world[2]
    n1 = R[0, 1] * world[0] + R[1, 1] * world[1] + R[2, 1] * world[2]
    n2 = R[0, 2] * world[0] + R[1, 2] * world[1] + R[2, 2] * world[2]
    dot = n0 * observed[0] + n1 * observed[1] + n2 * observed[2]
    for k in range(3):
        for b in range(6):
            J[k, b] = 0.0
    if kind == PERPENDICULAR:
        r[0] = dot
        o0, o1, o2 = observed[0], observed[1], observed[2]
        J[0, 3], J[0, 4], J[0, 5] = o1 * n2 - o2 * n1, o2 * n0 - o0 * n2, o0 * n1 - o1 * n0
        return 1
    sign = -1.0 if kind == PARALLEL and dot < 0.0 else 1.0
    for k in range(2):
        b0, b1, b2 = sign * B[0, k], sign * B[1, k], sign * B[2, k]
        r[k] = b0 * n0 + b1 * n1 + b2 * n2
        J[k, 3], J[k, 4], J[k, 5] = b1 * n2 - b2 * n1, b2 * n0 - b0 * n2, b0 * n1 - b1 * n0  # bᵀ [n]×, when the camera turns
    if kind == PARALLEL:
        return 2
    r[2] = world[3] + world[0] * t[0] + world[1] * t[1] + world[2] * t[2] - observed[3]
    J[2, 0], J[2, 1], J[2, 2] = n0, n1, n2
    return 3


@kernel(forceinline=True)
def plane_landmark_jacobians(kind: int, R: F64, t: F64, world: F64, observed: F64, Bw: F64, B: F64, F: F64, G: F64) -> None:
    """Jacobians (3, 3) of `plane_residual` by (a, b, d) of the map plane, F, and of the observed plane, G, with tangent bases Bw and B; up to the
    sign."""
    for i in range(3):
        for j in range(3):
            F[i, j] = G[i, j] = 0.0
    if kind == PERPENDICULAR:
        for j in range(2):
            for i in range(3):
                normal = R[i, 0] * observed[0] + R[i, 1] * observed[1] + R[i, 2] * observed[2]
                F[0, j] += normal * Bw[i, j]
                G[0, j] += (R[0, i] * world[0] + R[1, i] * world[1] + R[2, i] * world[2]) * B[i, j]
    else:
        for j in range(2):
            for k in range(2):
                for i in range(3):
                    F[k, j] += B[i, k] * (R[0, i] * Bw[0, j] + R[1, i] * Bw[1, j] + R[2, i] * Bw[2, j])
            G[j, j] = 1.0
            if kind == SAME:
                F[2, j] = t[0] * Bw[0, j] + t[1] * Bw[1, j] + t[2] * Bw[2, j]
        if kind == SAME:
            F[2, 2] = G[2, 2] = 1.0


# Information matrices of the residuals: noise of the measurement plus the landmark's covariance, at the pose of a round.


@kernel(forceinline=True)
def invert_small(S: F64, rows: int, W: F64) -> None:
    """Invert the leading block of 1, 2 or 3 rows of a symmetric matrix into W; the rest is 0."""
    W[:] = 0.0
    if rows == 1:
        W[0, 0] = 1.0 / S[0, 0]
        return
    if rows == 2:
        det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
        W[0, 0], W[1, 1], W[0, 1], W[1, 0] = S[1, 1] / det, S[0, 0] / det, -S[0, 1] / det, -S[1, 0] / det
        return
    W[0, 0] = S[1, 1] * S[2, 2] - S[1, 2] * S[2, 1]
    W[0, 1] = S[0, 2] * S[2, 1] - S[0, 1] * S[2, 2]
    W[0, 2] = S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]
    W[1, 1] = S[0, 0] * S[2, 2] - S[0, 2] * S[2, 0]
    W[1, 2] = S[0, 2] * S[1, 0] - S[0, 0] * S[1, 2]
    W[2, 2] = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
    W[1, 0], W[2, 0], W[2, 1] = W[0, 1], W[0, 2], W[1, 2]
    det = S[0, 0] * W[0, 0] + S[0, 1] * W[1, 0] + S[0, 2] * W[2, 0]
    for i in range(3):
        for j in range(3):
            W[i, j] /= det


@kernel(forceinline=True)
def _world_variance(d: F64, R: F64, S: F64) -> float:
    """Variance along the camera-frame direction d of a world covariance S (3, 3)."""
    x = R[0, 0] * d[0] + R[0, 1] * d[1] + R[0, 2] * d[2]
    y = R[1, 0] * d[0] + R[1, 1] * d[1] + R[1, 2] * d[2]
    z = R[2, 0] * d[0] + R[2, 1] * d[1] + R[2, 2] * d[2]
    total = x * S[0, 0] * x + x * S[0, 1] * y + x * S[0, 2] * z
    total = total + y * S[1, 0] * x + y * S[1, 1] * y + y * S[1, 2] * z
    return total + z * S[2, 0] * x + z * S[2, 1] * y + z * S[2, 2] * z


@kernel(forceinline=True)
def _variance(d: F64, S: F64) -> float:
    """Variance `dᵀ S d` along d (3,) of a covariance S (3, 3) of the same frame."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += d[i] * S[i, j] * d[j]
    return total


@kernel
def _weigh_points(R: F64, t: F64, camera: F64, terms: PointTerms, W: F64) -> None:
    """Invert the pixel and inverse-depth noise plus the projected covariance of the landmark, per point; in scalars, as in `_add_points`."""
    for i in range(len(terms.positions_m)):
        x, y, z = terms.positions_m[i, 0] - t[0], terms.positions_m[i, 1] - t[1], terms.positions_m[i, 2] - t[2]
        p2 = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
        W[i] = 0.0
        if not p2 > NEAR_M:
            continue
        iz, depth = 1.0 / p2, terms.depth_m[i]
        d00, d11 = camera[0] * iz, camera[1] * iz
        d02 = -d00 * (R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) * iz
        d12 = -d11 * (R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) * iz
        d22 = -iz * iz if np.isfinite(depth) else 0.0
        u0, u1, u2 = d00 * R[0, 0] + d02 * R[0, 2], d00 * R[1, 0] + d02 * R[1, 2], d00 * R[2, 0] + d02 * R[2, 2]  # rows of D Rᵀ
        v0, v1, v2 = d11 * R[0, 1] + d12 * R[0, 2], d11 * R[1, 1] + d12 * R[1, 2], d11 * R[2, 1] + d12 * R[2, 2]
        c00, c01, c02 = terms.covariance_m2[i, 0, 0], terms.covariance_m2[i, 0, 1], terms.covariance_m2[i, 0, 2]
        c11, c12, c22 = terms.covariance_m2[i, 1, 1], terms.covariance_m2[i, 1, 2], terms.covariance_m2[i, 2, 2]
        f0, f1, f2 = c00 * u0 + c01 * u1 + c02 * u2, c01 * u0 + c11 * u1 + c12 * u2, c02 * u0 + c12 * u1 + c22 * u2
        g0, g1, g2 = c00 * v0 + c01 * v1 + c02 * v2, c01 * v0 + c11 * v1 + c12 * v2, c02 * v0 + c12 * v1 + c22 * v2
        noise = terms.sigma_px[i] * terms.sigma_px[i]
        s00, s01, s11 = u0 * f0 + u1 * f1 + u2 * f2 + noise, v0 * f0 + v1 * f1 + v2 * f2, v0 * g0 + v1 * g1 + v2 * g2 + noise
        if d22 == 0.0:
            det = s00 * s11 - s01 * s01
            W[i, 0, 0], W[i, 1, 1], W[i, 0, 1], W[i, 1, 0] = s11 / det, s00 / det, -s01 / det, -s01 / det
            continue
        k0, k1, k2 = d22 * R[0, 2], d22 * R[1, 2], d22 * R[2, 2]
        s02, s12 = k0 * f0 + k1 * f1 + k2 * f2, k0 * g0 + k1 * g1 + k2 * g2
        s22 = k0 * (c00 * k0 + c01 * k1 + c02 * k2) + k1 * (c01 * k0 + c11 * k1 + c12 * k2) + k2 * (c02 * k0 + c12 * k1 + c22 * k2)
        s22 += (terms.sigma_m[i] / (depth * depth)) ** 2
        m00, m01, m02 = s11 * s22 - s12 * s12, s02 * s12 - s01 * s22, s01 * s12 - s02 * s11
        det = s00 * m00 + s01 * m01 + s02 * m02
        W[i, 0, 0], W[i, 1, 1], W[i, 2, 2] = m00 / det, (s00 * s22 - s02 * s02) / det, (s00 * s11 - s01 * s01) / det
        W[i, 0, 1], W[i, 0, 2], W[i, 1, 2] = m01 / det, m02 / det, (s02 * s01 - s00 * s12) / det
        W[i, 1, 0], W[i, 2, 0], W[i, 2, 1] = W[i, 0, 1], W[i, 0, 2], W[i, 1, 2]


@kernel(forceinline=True)
def _pair_noise(s0: float, s1: float, at_start: float, at_end: float, map0: float, map1: float, S: F64) -> None:
    """Covariance S (2, 2) of the distances at parameters s0, s1 along a segment whose ends have the given variances, plus those of the map's
    points."""
    S[0, 0] = (1.0 - s0) ** 2 * at_start + s0 * s0 * at_end + map0
    S[1, 1] = (1.0 - s1) ** 2 * at_start + s1 * s1 * at_end + map1
    S[0, 1] = S[1, 0] = (1.0 - s0) * (1.0 - s1) * at_start + s0 * s1 * at_end


@kernel
def _weigh_lines(R: F64, t: F64, camera: F64, terms: LineTerms, W: F64, V: F64) -> None:
    """Invert the noise of the observed ends, extrapolated to the projections of the map's points, plus the covariance of the map's points: W in the
    image, V in depth."""
    p, D, m, S = np.empty((2, 3)), np.empty((2, 3)), np.empty(3), np.empty((2, 2))
    for i in range(len(terms.endpoints_m)):
        W[i], V[i] = 0.0, 0.0
        to_camera(R, t, terms.endpoints_m[i, 0], p[0])
        to_camera(R, t, terms.endpoints_m[i, 1], p[1])
        if not (p[0, 2] > NEAR_M and p[1, 2] > NEAR_M):
            continue
        s0 = line_residual(p[0], terms.endpoints_px[i], camera, D[0])[1]
        s1 = line_residual(p[1], terms.endpoints_px[i], camera, D[1])[1]
        C, noise = terms.covariance_m2[i], terms.sigma_px[i] ** 2
        _pair_noise(s0, s1, noise, noise, _world_variance(D[0], R, C[0]), _world_variance(D[1], R, C[1]), S)
        invert_small(S, len(S), W[i])
        if depth_direction(terms.observed_m[i], m):
            s0 = line_depth_residual(p[0], terms.observed_m[i], m)[1]
            s1 = line_depth_residual(p[1], terms.observed_m[i], m)[1]
            Q = terms.observed_covariance_m2[i]
            _pair_noise(s0, s1, _variance(m, Q[0]), _variance(m, Q[1]), _world_variance(m, R, C[0]), _world_variance(m, R, C[1]), S)
            invert_small(S, len(S), V[i])


@kernel
def _weigh_planes(R: F64, t: F64, terms: PlaneTerms, W: F64) -> None:
    """Invert `F Σ_map Fᵀ + G Σ_observed Gᵀ`, per plane pair."""
    Bw, B, F, G, S = np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(terms.kinds)):
        tangent_columns(terms.coefficients[i], Bw)
        tangent_columns(terms.observed[i], B)
        plane_landmark_jacobians(terms.kinds[i], R, t, terms.coefficients[i], terms.observed[i], Bw, B, F, G)
        rows, numbers = residual_dimension(terms.kinds[i]), 3 if terms.kinds[i] == SAME else 2  # of how far away walls are, relations say nothing
        for a in range(rows):
            for b in range(rows):
                total = 0.0
                for j in range(numbers):
                    for k in range(numbers):
                        total += F[a, j] * terms.covariance[i, j, k] * F[b, k] + G[a, j] * terms.observed_covariance[i, j, k] * G[b, k]
                S[a, b] = total
        invert_small(S, rows, W[i])


@kernel
def fill_weights(R: F64, t: F64, camera: F64, points: PointTerms, lines: LineTerms, planes: PlaneTerms, weights: Weights) -> None:
    """Fill the information matrices of all residuals, linearised at the pose R, t."""
    _weigh_points(R, t, camera, points, weights.points)
    _weigh_lines(R, t, camera, lines, weights.lines, weights.line_depths)
    _weigh_planes(R, t, planes, weights.planes)


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
            _pose_jacobian_row(d0, d1, -(d0 * p[k, 0] + d1 * p[k, 1]) * iz, p, k, J)
        chi2[i], share = _add_pair(r[0], r[1], W, i, J, flags[i] != OUTLIER, robust, H, g)
        cost += share
        if chi2[i] == np.inf:
            cost += BEHIND if flags[i] else 0.0
        elif depth_direction(terms.observed_m[i], m):
            for k in range(2):
                r[k] = 0.0
                for a in range(3):
                    r[k] += m[a] * (p[k, a] - terms.observed_m[i, 0, a])
                _pose_jacobian_row(m[0], m[1], m[2], p, k, J)
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
    for i in range(n):
        a, b, k = i, i + 1, groups.points[i]
        one = PointTerms(
            points.positions_m[a:b], points.covariance_m2[a:b], points.pixels[a:b], points.depth_m[a:b], points.sigma_px[a:b], points.sigma_m[a:b]
        )
        _add_points(R, t, camera, one, weights.points[a:b], flags.points[a:b], False, 6, H[k], g[k], chi2.points[a:b])
    for i in range(m):
        a, b, k = i, i + 1, groups.lines[i]
        line = LineTerms(
            lines.endpoints_m[a:b], lines.covariance_m2[a:b], lines.endpoints_px[a:b], lines.sigma_px[a:b], lines.observed_m[a:b],
            lines.observed_covariance_m2[a:b],
        )  # fmt: skip
        W, V = weights.lines[a:b], weights.line_depths[a:b]
        _add_lines(R, t, camera, line, W, V, flags.lines[a:b], False, H[k], g[k], chi2.lines[a:b], chi2.line_depths[a:b])
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
    T[:3, :3], T[:3, 3] = R, t
    return T, covariance, information, dx, cost, complete


@kernel
def _copy(A: F64, a: F64, B: F64, b: F64) -> None:
    """Copy a matrix (n, n) and a vector (n,), a pose or normal equations, into B and b."""
    B[:], b[:] = A, a
