"""Kernels of rigid motions from three pairs of points at a time (RANSAC: Fischler and Bolles, CACM 1981): the best one, or all with their inliers."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import copy_matrix, polar_rotation
from trihedron.pipeline.core.types import F64, I32

LEAST_M = 0.05  # between the three points of a sample


@kernel
def _frame(a: F64, b: F64, c: F64, out: F64) -> bool:
    """Fill the axes (columns) spanned by three points; False when these are too near to each other or to a line."""
    ux, uy, uz, vx, vy, vz = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length, size = np.sqrt(ux * ux + uy * uy + uz * uz), np.sqrt(nx * nx + ny * ny + nz * nz)
    if length < LEAST_M or size < LEAST_M * length:
        return False
    ux, uy, uz, nx, ny, nz = ux / length, uy / length, uz / length, nx / size, ny / size, nz / size
    out[0, 0], out[1, 0], out[2, 0] = ux, uy, uz
    out[0, 1], out[1, 1], out[2, 1] = nx, ny, nz
    out[0, 2], out[1, 2], out[2, 2] = uy * nz - uz * ny, uz * nx - ux * nz, ux * ny - uy * nx
    return True


@kernel(forceinline=True)
def _squared_error(R: F64, t: F64, before: F64, after: F64, m: int) -> float:
    """Squared distance `|R before + t - after|²` of pair m."""
    total = 0.0
    for r in range(3):
        e = R[r, 0] * before[m, 0] + R[r, 1] * before[m, 1] + R[r, 2] * before[m, 2] + t[r] - after[m, r]
        total += e * e
    return total


@kernel
def best_motion(before: F64, after: F64, reach: F64, samples: I32) -> tuple[F64, F64]:
    """Return R and t of the sample (m, 3) with most pairs of points (n, 3) within `reach` (n,)."""
    best, R_best, t_best = -1, np.eye(3), np.zeros(3)
    A, B, R, t = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for s in range(len(samples)):
        i, j, k = samples[s]
        if not (_frame(before[i], before[j], before[k], A) and _frame(after[i], after[j], after[k], B)):
            continue
        for r in range(3):
            for c in range(3):
                R[r, c] = B[r, 0] * A[c, 0] + B[r, 1] * A[c, 1] + B[r, 2] * A[c, 2]
        for r in range(3):
            t[r] = 0.0
            for m in (i, j, k):
                t[r] += (after[m, r] - R[r, 0] * before[m, 0] - R[r, 1] * before[m, 1] - R[r, 2] * before[m, 2]) / 3.0
        count = 0
        for m in range(len(before)):
            count += _squared_error(R, t, before, after, m) < reach[m] * reach[m]
        if count > best:
            best, R_best, t_best = count, R.copy(), t.copy()
    return R_best, t_best


@kernel
def _is_consistent(camera_m: F64, world_m: F64, limit: F64, i: int, j: int) -> bool:
    """Return True if two points have the same distance in the camera and in the world, and one that is long enough."""
    here, there = 0.0, 0.0
    for r in range(3):
        here += (camera_m[i, r] - camera_m[j, r]) ** 2
        there += (world_m[i, r] - world_m[j, r]) ** 2
    return here > 0.1**2 and abs(np.sqrt(here) - np.sqrt(there)) <= limit[i] + limit[j]


@kernel
def rigid_hypotheses_kernel(camera_m: F64, world_m: F64, limit: F64, samples: I32) -> tuple[F64, I32]:
    """Solve the pose of each sample and count its inliers; 0 for one whose triangles differ."""
    poses, inliers = np.zeros((len(samples), 4, 4)), np.zeros(len(samples), np.int32)
    M, p, q, t = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(samples)):
        a, b, c = samples[k, 0], samples[k, 1], samples[k, 2]
        if a in (b, c) or b == c:
            continue
        if not (
            _is_consistent(camera_m, world_m, limit, a, b)
            and _is_consistent(camera_m, world_m, limit, b, c)
            and _is_consistent(camera_m, world_m, limit, c, a)
        ):
            continue
        for r in range(3):
            p[r] = (camera_m[a, r] + camera_m[b, r] + camera_m[c, r]) / 3.0
            q[r] = (world_m[a, r] + world_m[b, r] + world_m[c, r]) / 3.0
        for r in range(3):
            for s in range(3):
                M[r, s] = 0.0
                for i in (a, b, c):
                    M[r, s] += (world_m[i, r] - q[r]) * (camera_m[i, s] - p[s])
        R = polar_rotation(M)
        for r in range(3):
            t[r] = q[r] - (R[r, 0] * p[0] + R[r, 1] * p[1] + R[r, 2] * p[2])
        for i in range(len(camera_m)):
            inliers[k] += _squared_error(R, t, camera_m, world_m, i) <= limit[i] * limit[i]
        copy_matrix(R, poses[k])
        poses[k, 0, 3], poses[k, 1, 3], poses[k, 2, 3], poses[k, 3, 3] = t[0], t[1], t[2], 1.0
    return poses, inliers
