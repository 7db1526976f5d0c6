"""Kernels of the landmark map: information filters of points and lines (insertion), samples of planes (insertion, merging), redundancy (culling)."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, Bool
from trihedron.plugins.shared.pose_optimizer_kernels import (
    NEAR_M,
    depth_direction,
    invert_small,
    line_depth_residual,
    line_residual,
    point_residual,
    pose_jacobian,
    rotation_and_translation,
    to_camera,
)

FARTHER = 1.2  # a landmark observed from at most this many times as far is observed as well: a level of the key points' pyramid

# Information filters: a keyframe's observations update point and line landmarks.


@kernel
def _pose_noise(D: F64, p: F64, pose_covariance: F64, rows: int, J: F64, S: F64) -> None:
    """Fill S with the covariance that the pose adds to residuals with Jacobian D (rows, 3) by the camera-frame point p."""
    pose_jacobian(D, rows, p, J)
    for a in range(rows):
        for b in range(rows):
            S[a, b] = 0.0
            for i in range(6):
                for j in range(6):
                    S[a, b] += J[a, i] * pose_covariance[i, j] * J[b, j]


@kernel
def _update(position: F64, information: F64, R: F64, D: F64, r: F64, S: F64, rows: int) -> None:
    """Update a landmark in place by one Gauss–Newton step on r (rows,), with Jacobian D by the camera-frame point and covariance S."""
    W, C, E, g = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    invert_small(S, rows, W)
    for k in range(rows):
        for j in range(3):
            E[k, j] = D[k, 0] * R[j, 0] + D[k, 1] * R[j, 1] + D[k, 2] * R[j, 2]
    for a in range(rows):
        for b in range(rows):
            for i in range(3):
                g[i] += E[a, i] * W[a, b] * r[b]
                for j in range(3):
                    information[i, j] += E[a, i] * W[a, b] * E[b, j]
    invert_small(information, len(information), C)
    for i in range(3):
        position[i] -= C[i, 0] * g[0] + C[i, 1] * g[1] + C[i, 2] * g[2]


@kernel
def _fade_across(information: F64, ends: F64, share: float) -> None:
    """Multiply the information (3, 3) of a line's end by `share` across the line, in place. Along it, where segments measure nothing, it stays: it
    would otherwise vanish beside the rest, and rounding would give the matrix a negative eigenvalue."""
    length, u, row, along, root = 0.0, np.empty(3), np.empty(3), 0.0, np.sqrt(share)
    for k in range(3):
        u[k] = ends[1, k] - ends[0, k]
        length += u[k] * u[k]
    length = max(np.sqrt(length), 1e-12)
    for k in range(3):
        u[k] /= length
    for i in range(3):
        row[i] = information[i, 0] * u[0] + information[i, 1] * u[1] + information[i, 2] * u[2]
        along += u[i] * row[i]
    for i in range(3):  # S information S with S = root · 1 + (1 - root) u uᵀ
        for j in range(3):
            mixed = root * (1.0 - root) * (row[i] * u[j] + u[i] * row[j]) + (1.0 - root) ** 2 * along * u[i] * u[j]
            information[i, j] = share * information[i, j] + mixed


@kernel
def fuse_points(
    T_world_camera: F64,
    pose_covariance: F64,
    camera: F64,
    positions: F64,
    information: F64,
    pixels: F64,
    depth_m: F64,
    sigma_px: F64,
    sigma_m: F64,
    memory: float,
) -> None:
    """Update positions (n, 3) and information (n, 3, 3), in place, by pixels (n, 2) and depths (n,; NaN = none) measured from an uncertain pose.

    The old information is first multiplied by `1 - 1/memory`: it stays that of at most `memory` measurements, so that a landmark can still move."""
    R, t = rotation_and_translation(T_world_camera)
    p, r, D, J, S = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3))
    for i in range(len(positions)):
        to_camera(R, t, positions[i], p)
        if not point_residual(p, pixels[i], depth_m[i], camera, r, D):
            continue
        rows = 3 if np.isfinite(depth_m[i]) else 2
        _pose_noise(D, p, pose_covariance, 3, J, S)
        S[0, 0] += sigma_px[i] ** 2
        S[1, 1] += sigma_px[i] ** 2
        if rows == 3:
            S[2, 2] += (sigma_m[i] / depth_m[i] ** 2) ** 2
        for a in range(3):
            for b in range(3):
                information[i, a, b] *= 1.0 - 1.0 / memory
        _update(positions[i], information[i], R, D, r, S, rows)


@kernel
def fuse_lines(
    T_world_camera: F64,
    pose_covariance: F64,
    camera: F64,
    endpoints: F64,
    information: F64,
    endpoints_px: F64,
    observed_m: F64,
    observed_covariance: F64,
    sigma_px: float,
    memory: float,
) -> None:
    """Update both ends (n, 2, 3) of lines and their information (n, 2, 3, 3), in place, across the line only: in the image by the distance from the
    segment seen, in depth by that from its 3D line where it has one (NaN = none)."""
    R, t = rotation_and_translation(T_world_camera)
    p, r, D, J, m, S = np.empty(3), np.empty(2), np.empty((2, 3)), np.empty((2, 6)), np.empty(3), np.empty((2, 2))
    ends = np.empty(2)
    for i in range(len(endpoints)):
        deep = depth_direction(observed_m[i], m)
        for k in range(2):
            ends[k] = 0.0
            for a in range(3):
                for b in range(3):
                    ends[k] += m[a] * observed_covariance[i, k, a, b] * m[b]
        for k in range(2):
            to_camera(R, t, endpoints[i, k], p)
            if not p[2] > NEAR_M:
                continue
            rows, r[1], D[1, 0], D[1, 1], D[1, 2] = 1, 0.0, 0.0, 0.0, 0.0
            r[0], s = line_residual(p, endpoints_px[i], camera, D[0])
            noise = sigma_px**2 * ((1.0 - s) ** 2 + s * s)
            if deep:
                rows = 2
                r[1], s = line_depth_residual(p, observed_m[i], m)
                D[1, 0], D[1, 1], D[1, 2] = m[0], m[1], m[2]
            _pose_noise(D, p, pose_covariance, rows, J, S)
            S[0, 0] += noise
            if deep:
                S[1, 1] += (1.0 - s) ** 2 * ends[0] + s * s * ends[1]
            _fade_across(information[i, k], endpoints[i], 1.0 - 1.0 / memory)
            _update(endpoints[i, k], information[i, k], R, D, r, S, rows)


# Samples of planes.


@kernel
def farthest_samples(points: F32, count: int) -> F32:
    """Select up to `count` finite rows of points (n, 3), each the farthest from those before it; NaN-padded (count, 3)."""
    out = np.full((count, 3), np.nan, np.float32)
    n = 0
    kept = np.empty((len(points), 3), np.float32)
    for i in range(len(points)):
        if np.isfinite(points[i, 0]):
            kept[n] = points[i]
            n += 1
    distance = np.full(n, np.inf)
    chosen = 0
    for k in range(min(n, count)):
        out[k] = kept[chosen]
        x, y, z = kept[chosen, 0], kept[chosen, 1], kept[chosen, 2]
        farthest = -1.0
        for i in range(n):
            distance[i] = min(distance[i], (kept[i, 0] - x) ** 2 + (kept[i, 1] - y) ** 2 + (kept[i, 2] - z) ** 2)
            if distance[i] > farthest:
                farthest, chosen = distance[i], i
    return out


# Redundancy of keyframes.


@kernel
def count_redundant(
    observed: I32, ends: NDArray[np.int64], keyframes: I32, observers: I32, centres: F64, rows: I32, poses: F64, alive: Bool, others: int
) -> NDArray[np.int64]:
    """Count the landmarks of each keyframe, and those of them that at least `others` further living keyframes observed from as near: (2, n).

    `observed` are the landmarks of each keyframe in turn up to its end, -1 = not counted; `observers` (m, OBSERVERS) and `centres` (m, 3) are those
    of the landmarks; `poses` (k, 4, 4) and `alive` (k,) those of the keyframes `rows`, sorted, which include all observers."""
    place, counts = np.empty(rows[-1] + 1, np.int32), np.zeros((2, len(keyframes)), np.int64)
    for k in range(len(rows)):
        place[rows[k]] = k
    counted, begin = np.full(len(centres), -1), 0  # the last keyframe that a landmark was counted for
    for k in range(len(keyframes)):
        for o in range(begin, ends[k]):
            i = observed[o]
            if i < 0 or counted[i] == k:
                continue
            counted[i] = k
            reach, count = FARTHER * _distance(poses[place[keyframes[k]]], centres[i]), 0
            for row in observers[i]:
                if row >= 0 and row != keyframes[k] and alive[place[row]]:
                    count += _distance(poses[place[row]], centres[i]) <= reach
            counts[0, k] += 1
            counts[1, k] += count >= others
        begin = ends[k]
    return counts


@kernel
def _distance(T: F64, p: F64) -> float:
    """Distance of a point from a camera."""
    x, y, z = T[0, 3] - p[0], T[1, 3] - p[1], T[2, 3] - p[2]
    return np.sqrt(x * x + y * y + z * z)
