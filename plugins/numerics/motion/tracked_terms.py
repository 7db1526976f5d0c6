"""Features of the previous frame placed in the world by its pose, with the noise of what they were measured from: terms for the pose solver."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, Camera
from trihedron.plugins.numerics.algebra.constant_arrays import constant
from trihedron.plugins.numerics.motion.pose_terms import basis


def placed_points(points_m: F32, sigma_px: F32, sigma_m: F32, camera: Camera, T_world_camera: F64, rotation_covariance: F64) -> tuple[F64, F64]:
    """Camera-frame points (n, 3) in the world, and their covariances (n, 3, 3) there: `sigma_px` (n,) across the ray, `sigma_m` (n,) of the depth,
    and what a rotation of the camera known to `rotation_covariance` (3, 3, rad²) adds."""
    return _placed(
        constant(points_m, np.float32), constant(sigma_px, np.float32), constant(sigma_m, np.float32),
        float(camera.fx), float(camera.fy), constant(T_world_camera, np.float64), constant(rotation_covariance, np.float64),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _placed(points: F32, sigma_px: F32, sigma_m: F32, fx: float, fy: float, T: F64, turned: F64) -> tuple[F64, F64]:
    """`σ_m² r rᵀ + diag(z σ_px / f)² + [p]× Σ [p]×ᵀ` with the ray r = p / z, turned into the world."""
    n = len(points)
    world, covariance = np.empty((n, 3)), np.empty((n, 3, 3))
    p, P, M, C = np.empty(3), np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(n):
        for a in range(3):
            p[a] = points[i, a]
        for a in range(3):
            world[i, a] = T[a, 0] * p[0] + T[a, 1] * p[1] + T[a, 2] * p[2] + T[a, 3]
        P[0, 1], P[0, 2], P[1, 0], P[1, 2], P[2, 0], P[2, 1] = -p[2], p[1], p[2], -p[0], -p[1], p[0]
        along2, across = (float(sigma_m[i]) / p[2]) ** 2, p[2] * float(sigma_px[i])
        _sandwich(P, turned, M, C)
        for a in range(3):
            for b in range(3):
                C[a, b] += along2 * p[a] * p[b]
        C[0, 0] += (across / fx) ** 2
        C[1, 1] += (across / fy) ** 2
        _sandwich(T[:3, :3], C, M, covariance[i])
    return world, covariance


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sandwich(A: F64, C: F64, M: F64, out: F64) -> None:
    """`out = A C Aᵀ`, all (3, 3); M is scratch."""
    for a in range(3):
        for b in range(3):
            M[a, b] = A[a, 0] * C[0, b] + A[a, 1] * C[1, b] + A[a, 2] * C[2, b]
    for a in range(3):
        for b in range(3):
            out[a, b] = M[a, 0] * A[b, 0] + M[a, 1] * A[b, 1] + M[a, 2] * A[b, 2]


def placed_planes(planes: F64, covariance: F64, observed: F64, T_world_camera: F64, rotation_covariance: F64) -> tuple[F64, F64, F64]:
    """Camera-frame planes (n, 4) in the world, their covariances (n, 3, 3) of (a, b, d) there, and what a rotation of the camera known to
    `rotation_covariance` (3, 3, rad²) adds to the covariances of the `observed` ones (n, 4): to the normal only."""
    return _placed_planes(
        constant(planes, np.float64), constant(covariance, np.float64), constant(observed, np.float64),
        constant(T_world_camera, np.float64), constant(rotation_covariance, np.float64),
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _placed_planes(planes: F64, covariance: F64, observed: F64, T: F64, turned: F64) -> tuple[F64, F64, F64]:
    n = len(planes)
    world, moved, added = np.empty((n, 4)), np.empty((n, 3, 3)), np.zeros((n, 3, 3))
    before, after, J, M, F, Q = np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 3)), np.zeros((3, 3)), np.empty((2, 3))
    F[2, 2] = 1.0
    for i in range(n):
        world[i, 3] = planes[i, 3]
        for a in range(3):
            world[i, a] = T[a, 0] * planes[i, 0] + T[a, 1] * planes[i, 1] + T[a, 2] * planes[i, 2]
            world[i, 3] -= world[i, a] * T[a, 3]
        basis(planes[i, :3], before)
        basis(world[i, :3], after)
        for k in range(2):
            F[2, k] = 0.0
            for a in range(3):
                J[a, k] = T[a, 0] * before[0, k] + T[a, 1] * before[1, k] + T[a, 2] * before[2, k]  # how the world's normal moves
                F[2, k] -= T[a, 3] * J[a, k]
        for j in range(2):
            for k in range(2):
                F[j, k] = after[0, j] * J[0, k] + after[1, j] * J[1, k] + after[2, j] * J[2, k]
        _sandwich(F, covariance[i], M, moved[i])
        basis(observed[i, :3], before)
        x, y, z = observed[i, 0], observed[i, 1], observed[i, 2]
        for k in range(2):  # rows of Bᵀ [n]×
            Q[k, 0] = before[1, k] * z - before[2, k] * y
            Q[k, 1] = before[2, k] * x - before[0, k] * z
            Q[k, 2] = before[0, k] * y - before[1, k] * x
        for j in range(2):
            for k in range(2):
                for a in range(3):
                    for b in range(3):
                        added[i, j, k] += Q[j, a] * turned[a, b] * Q[k, b]
    return world, moved, added
