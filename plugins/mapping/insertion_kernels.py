"""Numba kernels of `insertion.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64
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

# Information filters that move point and line landmarks by what a keyframe measured of them.


@kernel
def _noise(D: F64, p: F64, pose_covariance: F64, rows: int, J: F64, S: F64) -> None:
    """S: covariance that an uncertain pose gives to residuals with derivatives D (rows, 3) by the camera-frame point p."""
    pose_jacobian(D, rows, p, J)
    for a in range(rows):
        for b in range(rows):
            S[a, b] = 0.0
            for i in range(6):
                for j in range(6):
                    S[a, b] += J[a, i] * pose_covariance[i, j] * J[b, j]


@kernel
def _update(position: F64, information: F64, R: F64, D: F64, r: F64, S: F64, rows: int) -> None:
    """One Gauss–Newton step of a landmark on r (rows,), whose derivative by the camera-frame point is D and covariance S; in place."""
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
    """Information (3, 3) of a line's end times `share` across the line, in place. Along it, where no segment says anything, it stays: forgotten and
    never measured again it would vanish beside the other, and a rounded matrix is then no information any more, but has a negative eigenvalue."""
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
    """Update positions (n, 3) and information (n, 3, 3), in place, by pixels (n, 2) and depths (n,; NaN = none) seen from an uncertain pose.

    The old information is first multiplied by `1 - 1/memory`: it stays that of at most `memory` measurements, so that a landmark can still move."""
    R, t = rotation_and_translation(T_world_camera)
    p, r, D, J, S = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3))
    for i in range(len(positions)):
        to_camera(R, t, positions[i], p)
        if not point_residual(p, pixels[i], depth_m[i], camera, r, D):
            continue
        rows = 3 if np.isfinite(depth_m[i]) else 2
        _noise(D, p, pose_covariance, 3, J, S)
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
            _noise(D, p, pose_covariance, rows, J, S)
            S[0, 0] += noise
            if deep:
                S[1, 1] += (1.0 - s) ** 2 * ends[0] + s * s * ends[1]
            _fade_across(information[i, k], endpoints[i], 1.0 - 1.0 / memory)
            _update(endpoints[i, k], information[i, k], R, D, r, S, rows)
