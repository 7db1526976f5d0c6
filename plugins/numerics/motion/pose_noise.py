"""The noise of the pose solver's residuals: of the measurement and of the landmark, at a given pose."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64
from trihedron.plugins.numerics.motion.pose_terms import (
    NEAR_M,
    PERPENDICULAR,
    SAME,
    LineTerms,
    PlaneTerms,
    PointTerms,
    basis,
    depth_direction,
    line_depth_row,
    line_row,
    plane_slopes,
    to_camera,
)


class Weights(NamedTuple):
    """Inverse covariances of the residuals, held during a round."""

    points: F64  # (n, 3, 3)
    lines: F64  # (m, 2, 2) image distances
    line_depths: F64  # (m, 2, 2)
    planes: F64  # (p, 3, 3)


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def invert_small(S: F64, rows: int, W: F64) -> None:
    """Inverse of the leading block of 1, 2 or 3 rows of a symmetric matrix into W; the rest 0."""
    for i in range(len(W)):
        for j in range(len(W)):
            W[i, j] = 0.0
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


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _spread(d: F64, R: F64, S: F64) -> float:
    """Variance along the camera-frame direction d of a world covariance S."""
    x = R[0, 0] * d[0] + R[0, 1] * d[1] + R[0, 2] * d[2]
    y = R[1, 0] * d[0] + R[1, 1] * d[1] + R[1, 2] * d[2]
    z = R[2, 0] * d[0] + R[2, 1] * d[1] + R[2, 2] * d[2]
    total = x * S[0, 0] * x + x * S[0, 1] * y + x * S[0, 2] * z
    total = total + y * S[1, 0] * x + y * S[1, 1] * y + y * S[1, 2] * z
    return total + z * S[2, 0] * x + z * S[2, 1] * y + z * S[2, 2] * z


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _quadratic(d: F64, S: F64) -> float:
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += d[i] * S[i, j] * d[j]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weigh_points(R: F64, t: F64, camera: F64, terms: PointTerms, W: F64) -> None:
    """Pixel and inverse-depth noise plus the landmark's own covariance, projected at this pose. In scalars, as `pose_kernel` has its points."""
    for i in range(len(terms.positions_m)):
        x, y, z = terms.positions_m[i, 0] - t[0], terms.positions_m[i, 1] - t[1], terms.positions_m[i, 2] - t[2]
        p2 = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
        for a in range(3):
            for b in range(3):
                W[i, a, b] = 0.0
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


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _pair_noise(s0: float, s1: float, at_start: float, at_end: float, map0: float, map1: float, S: F64) -> None:
    """Covariance of the distances at parameters s0, s1 along a segment whose ends have the given variances, plus those of the map's points."""
    S[0, 0] = (1.0 - s0) ** 2 * at_start + s0 * s0 * at_end + map0
    S[1, 1] = (1.0 - s1) ** 2 * at_start + s1 * s1 * at_end + map1
    S[0, 1] = S[1, 0] = (1.0 - s0) * (1.0 - s1) * at_start + s0 * s1 * at_end


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weigh_lines(R: F64, t: F64, camera: F64, terms: LineTerms, W: F64, V: F64) -> None:
    """Noise of the segment's ends, extrapolated to where the map's end points fall, plus that of the map's end points."""
    p, D, m, S = np.empty((2, 3)), np.empty((2, 3)), np.empty(3), np.empty((2, 2))
    for i in range(len(terms.endpoints_m)):
        for a in range(2):
            for b in range(2):
                W[i, a, b] = V[i, a, b] = 0.0
        to_camera(R, t, terms.endpoints_m[i, 0], p[0])
        to_camera(R, t, terms.endpoints_m[i, 1], p[1])
        if not (p[0, 2] > NEAR_M and p[1, 2] > NEAR_M):
            continue
        s0 = line_row(p[0], terms.endpoints_px[i], camera, D[0])[1]
        s1 = line_row(p[1], terms.endpoints_px[i], camera, D[1])[1]
        C, noise = terms.covariance_m2[i], terms.sigma_px[i] ** 2
        _pair_noise(s0, s1, noise, noise, _spread(D[0], R, C[0]), _spread(D[1], R, C[1]), S)
        invert_small(S, len(S), W[i])
        if depth_direction(terms.observed_m[i], m):
            s0 = line_depth_row(p[0], terms.observed_m[i], m)[1]
            s1 = line_depth_row(p[1], terms.observed_m[i], m)[1]
            Q = terms.observed_covariance_m2[i]
            _pair_noise(s0, s1, _quadratic(m, Q[0]), _quadratic(m, Q[1]), _spread(m, R, C[0]), _spread(m, R, C[1]), S)
            invert_small(S, len(S), V[i])


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def rows_of(kind: int) -> int:
    """Number of residuals of a kind of plane term."""
    return 3 if kind == SAME else (1 if kind == PERPENDICULAR else 2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weigh_planes(R: F64, t: F64, terms: PlaneTerms, W: F64) -> None:
    """Noise of the observed planes plus that of the map's."""
    Bw, B, F, G, S = np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(terms.kinds)):
        basis(terms.coefficients[i], Bw)
        basis(terms.observed[i], B)
        plane_slopes(terms.kinds[i], R, t, terms.coefficients[i], terms.observed[i], Bw, B, F, G)
        rows, numbers = rows_of(terms.kinds[i]), 3 if terms.kinds[i] == SAME else 2  # of how far away walls are, relations say nothing
        for a in range(rows):
            for b in range(rows):
                total = 0.0
                for j in range(numbers):
                    for k in range(numbers):
                        total += F[a, j] * terms.covariance[i, j, k] * F[b, k] + G[a, j] * terms.observed_covariance[i, j, k] * G[b, k]
                S[a, b] = total
        invert_small(S, rows, W[i])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def weigh(R: F64, t: F64, camera: F64, points: PointTerms, lines: LineTerms, planes: PlaneTerms, weights: Weights) -> None:
    """Fill `weights` for the pose R, t."""
    _weigh_points(R, t, camera, points, weights.points)
    _weigh_lines(R, t, camera, lines, weights.lines, weights.line_depths)
    _weigh_planes(R, t, planes, weights.planes)
