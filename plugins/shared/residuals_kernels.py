"""Residuals of points, lines and planes at a camera pose, with their Jacobians and information matrices (eqs. 2–8).

The pose is `R, t` of `T_world_camera`; derivatives are by `xi = (rho, phi)` in `T_world_camera · Exp(xi)`; `camera` is (fx, fy, cx, cy). First
the terms: world landmarks and their observations; then residuals and Jacobians; then information matrices.

Helpers of single terms are inlined (`forceinline`): passing an array costs numba seven numbers and a reference count, as much as the helper itself.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import invert_small, tangent_columns
from trihedron.pipeline.core.types import F64, I32

# The parameters of the problem: world landmarks and their observations.

SAME, PARALLEL, PERPENDICULAR = 0, 1, 2  # kinds of plane terms
NEAR_M = 0.05  # a point nearer than this to the image plane is not projected


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
def pose_jacobian_row(a: float, b: float, c: float, p: F64, k: int, J: F64) -> None:
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
def _world_variance(d: F64, R: F64, S: F64) -> float:
    """Variance along the camera-frame direction d of a world covariance S (3, 3)."""
    x = R[0, 0] * d[0] + R[0, 1] * d[1] + R[0, 2] * d[2]
    y = R[1, 0] * d[0] + R[1, 1] * d[1] + R[1, 2] * d[2]
    z = R[2, 0] * d[0] + R[2, 1] * d[1] + R[2, 2] * d[2]
    total: float = x * S[0, 0] * x + x * S[0, 1] * y + x * S[0, 2] * z
    total = total + y * S[1, 0] * x + y * S[1, 1] * y + y * S[1, 2] * z
    total = total + z * S[2, 0] * x + z * S[2, 1] * y + z * S[2, 2] * z
    return total


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
