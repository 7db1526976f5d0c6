"""Numba kernels of `levenberg_marquardt.py`: tracked features of the previous frame in the world, with covariance, as terms of `solve_pose`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import tangent_columns
from trihedron.pipeline.core.types import F32, F64
from trihedron.plugins.shared.depth_image_kernels import sigma_z
from trihedron.plugins.shared.relative_motion_kernels import LinePairs, PlanePairs, PointPairs
from trihedron.plugins.shared.residuals_kernels import SAME, LineTerms, PlaneTerms, PointTerms


@kernel
def tracked_points(pairs: PointPairs, fx: float, fy: float, T: F64, rotation_covariance: F64) -> PointTerms:
    """Terms of the tracked points with a previous depth; T (4, 4) and `rotation_covariance` (3, 3) as in
    `placed_points`."""
    rows, before, before_sigma, points, pixels, sigma_px, sigma_m = pairs
    known = np.empty(len(rows), np.int32)
    n = 0
    for i in range(len(rows)):
        known[n] = i
        n += np.isfinite(before[i, 0] + before[i, 1] + before[i, 2])
    places, across, along = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    seen, depth, seen_px, seen_m = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    for k in range(n):
        i, j = known[k], rows[known[k], 1]
        for a in range(3):
            places[k, a] = before[i, a]
        across[k], along[k] = sigma_px[j], before_sigma[i]
        seen[k, 0], seen[k, 1], depth[k], seen_px[k], seen_m[k] = pixels[j, 0], pixels[j, 1], points[j, 2], sigma_px[j], sigma_m[j]
    world, covariance = placed_points(places, across, along, fx, fy, T, rotation_covariance)
    return PointTerms(world, covariance, seen, depth, seen_px, seen_m)


@kernel
def tracked_lines(
    pairs: LinePairs, sigma_px: float, noise: tuple[float, float, float, float], fx: float, fy: float, T: F64, rotation_covariance: F64
) -> LineTerms:
    """Terms of the tracked lines with previous 3D end points, observed with `sigma_px`."""
    rows, before, endpoints, pixels, covariance = pairs
    known = np.empty(len(rows), np.int32)
    n = 0
    for i in range(len(rows)):
        total = 0.0
        for a in range(3):
            total += before[i, 0, a] + before[i, 1, a]
        known[n] = i
        n += np.isfinite(total)
    places, across, along = np.empty((2 * n, 3), np.float32), np.full(2 * n, sigma_px).astype(np.float32), np.empty(2 * n, np.float32)
    seen, measured, of_measured = np.empty((n, 2, 2)), np.empty((n, 2, 3)), np.empty((n, 2, 3, 3))
    for k in range(n):
        i, j = known[k], rows[known[k], 1]
        for e in range(2):
            along[2 * k + e] = sigma_z(float(before[i, e, 2]), noise)
            seen[k, e, 0], seen[k, e, 1] = pixels[j, e, 0], pixels[j, e, 1]
            for a in range(3):
                places[2 * k + e, a], measured[k, e, a] = before[i, e, a], endpoints[j, e, a]
                for b in range(3):
                    of_measured[k, e, a, b] = covariance[j, e, a, b]
    world, of_world = placed_points(places, across, along, fx, fy, T, rotation_covariance)
    return LineTerms(world.reshape(n, 2, 3), of_world.reshape(n, 2, 3, 3), seen, np.full(n, sigma_px), measured, of_measured)


@kernel
def tracked_planes(pairs: PlanePairs, T: F64, rotation_covariance: F64) -> PlaneTerms:
    """Terms of all tracked planes."""
    rows, before, before_covariance, planes, covariance = pairs
    n = len(rows)
    observed, of_observed, kinds = np.empty((n, 4)), np.empty((n, 3, 3)), np.full(n, SAME, np.int32)
    for i in range(n):
        for a in range(4):
            observed[i, a] = planes[rows[i, 1], a]
    world, of_world, added = placed_planes(before, before_covariance, observed, T, rotation_covariance)
    for i in range(n):
        for a in range(3):
            for b in range(3):
                of_observed[i, a, b] = covariance[rows[i, 1], a, b] + added[i, a, b]
    return PlaneTerms(kinds, world, of_world, observed, of_observed)


@kernel
def placed_points(points: F32, sigma_px: F32, sigma_m: F32, fx: float, fy: float, T: F64, rotation_covariance: F64) -> tuple[F64, F64]:
    """Transform camera-frame points (n, 3) to the world by T (4, 4), `T_world_camera`, with their covariances (n, 3, 3) there:
    `R (σ_m² r rᵀ + diag(z σ_px / f)² + [p]× Σ [p]×ᵀ) Rᵀ`.

    `sigma_px` (n,) is across the ray r = p / z, `sigma_m` (n,) that of the depth, Σ the `rotation_covariance` (3, 3, rad²) of the current camera."""
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
        _sandwich(P, rotation_covariance, M, C)
        for a in range(3):
            for b in range(3):
                C[a, b] += along2 * p[a] * p[b]
        C[0, 0] += (across / fx) ** 2
        C[1, 1] += (across / fy) ** 2
        _sandwich(T[:3, :3], C, M, covariance[i])
    return world, covariance


@kernel(forceinline=True)
def _sandwich(A: F64, C: F64, M: F64, out: F64) -> None:
    """`out = A C Aᵀ`, all (3, 3); M is scratch."""
    for a in range(3):
        for b in range(3):
            M[a, b] = A[a, 0] * C[0, b] + A[a, 1] * C[1, b] + A[a, 2] * C[2, b]
    for a in range(3):
        for b in range(3):
            out[a, b] = M[a, 0] * A[b, 0] + M[a, 1] * A[b, 1] + M[a, 2] * A[b, 2]


@kernel
def placed_planes(planes: F64, covariance: F64, observed: F64, T: F64, rotation_covariance: F64) -> tuple[F64, F64, F64]:
    """Transform camera-frame planes (n, 4) to the world, with their covariances (n, 3, 3) of (a, b, d).

    Also returns the covariance (n, 3, 3) that the `rotation_covariance` (3, 3, rad²) of the current camera adds to the `observed` planes (n, 4): to
    the normal only."""
    n = len(planes)
    world, moved, added = np.empty((n, 4)), np.empty((n, 3, 3)), np.zeros((n, 3, 3))
    before, after, J, M, F, Q = np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 2)), np.empty((3, 3)), np.zeros((3, 3)), np.empty((2, 3))
    F[2, 2] = 1.0
    for i in range(n):
        world[i, 3] = planes[i, 3]
        for a in range(3):
            world[i, a] = T[a, 0] * planes[i, 0] + T[a, 1] * planes[i, 1] + T[a, 2] * planes[i, 2]
            world[i, 3] -= world[i, a] * T[a, 3]
        tangent_columns(planes[i, :3], before)
        tangent_columns(world[i, :3], after)
        for k in range(2):
            F[2, k] = 0.0
            for a in range(3):
                J[a, k] = T[a, 0] * before[0, k] + T[a, 1] * before[1, k] + T[a, 2] * before[2, k]  # derivative of the world's normal
                F[2, k] -= T[a, 3] * J[a, k]
        for j in range(2):
            for k in range(2):
                F[j, k] = after[0, j] * J[0, k] + after[1, j] * J[1, k] + after[2, j] * J[2, k]
        _sandwich(F, covariance[i], M, moved[i])
        tangent_columns(observed[i, :3], before)
        x, y, z = observed[i, 0], observed[i, 1], observed[i, 2]
        for k in range(2):  # rows of Bᵀ [n]×
            Q[k, 0] = before[1, k] * z - before[2, k] * y
            Q[k, 1] = before[2, k] * x - before[0, k] * z
            Q[k, 2] = before[0, k] * y - before[1, k] * x
        for j in range(2):
            for k in range(2):
                for a in range(3):
                    for b in range(3):
                        added[i, j, k] += Q[j, a] * rotation_covariance[a, b] * Q[k, b]
    return world, moved, added
