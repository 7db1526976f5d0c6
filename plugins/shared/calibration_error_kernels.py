"""Kernels of `calibration_error.py`: what residuals tell of the calibration, and its second moments.

A measurement errs by `M θ`: `keypoint_errors` in the image and in inverse depth, `plane_point_error` along a plane's normal. A landmark was placed by
the same camera from the keyframes that observed it, and errs with their mean, weighted by the information that each has of it. A residual shows the
difference, and the keyframes' own errors."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import copy_matrix, inverse_positive, invert_symmetric, matmul, matvec, split_pose, tangent_columns
from trihedron.pipeline.core.types import CALIBRATION, F32, F64, I32, U8
from trihedron.plugins.shared.depth_image_kernels import sigma_z
from trihedron.plugins.shared.lie_kernels import adjoint_between, rotation_between
from trihedron.plugins.shared.pose_optimizer_kernels import INLIER, Flags
from trihedron.plugins.shared.residuals_kernels import (
    NEAR_M,
    SAME,
    LineTerms,
    PlaneTerms,
    PointTerms,
    Weights,
    depth_direction,
    fill_weights,
    line_residual,
    plane_residual,
    point_residual,
    pose_jacobian,
    pose_jacobian_row,
    to_camera,
)

EXPECTATIONS = 8  # iterations for the common scale
PRIOR_COUNT = 4.0  # parameters that the prior of the common scale counts as
LEAST_SAMPLES = 4  # of a plane in both views, from which on it informs on the calibration


class Keyframes(NamedTuple):
    """The m keyframes that observed landmarks: rotations and positions of `T_world_keyframe`, velocities, errors by the calibration as those of
    xi of the camera, and the noise of their depth (`DepthNoise.coefficients`)."""

    R: F64  # (m, 3, 3)
    t: F64  # (m, 3)
    twists: F64  # (m, 6)
    errors: F64  # (m, 6, 12)
    noise: tuple[float, float, float, float]


class Observers(NamedTuple):
    """Numbers of the keyframes that observed each point (n, o), line (m, o) and identical plane (p, o), which are the first of the planes; -1 for
    none."""

    points: I32
    lines: I32
    planes: I32


class Surfaces(NamedTuple):
    """Planes in the camera's frame that points (n, 4) and the ends of lines (m, 2, 4) lie on, NaN for none: where the image errs, depth is read
    elsewhere on them."""

    points: F64
    lines: F64


class Equations(NamedTuple):
    """Normal equations by the pose, H (6, 6) and b (6,), and by the calibration, G (12, 12) and s (12,), with C (6, 12) between them.

    The depth of lines adds `H_depth` and `C_depth`: it moves the pose, but is no evidence of the calibration, since at an edge of two surfaces it is
    not known which of them it was read on."""

    H: F64
    b: F64
    C: F64
    G: F64
    s: F64
    H_depth: F64
    C_depth: F64


@kernel(forceinline=True)
def keypoint_errors(p: F64, plane: F64, twist: F64, camera: F64, width: int, height: int, E: F64) -> None:
    """Fill E (3, 12): errors of a key point's u, v (px) and of the inverse depth at it, by each parameter in its own unit.

    p (3,) is the point, `plane` (4,) the surface there (NaN: not known; its slope is then left out), both in the camera frame."""
    fx, fy, iz = camera[0], camera[1], 1.0 / p[2]
    x, y = fx * p[0] * iz, fy * p[1] * iz
    row = (y + camera[3]) / height - 0.5
    a = -twist[0] - twist[4] * p[2] + twist[5] * p[1]  # velocity of the point in the camera frame
    b = -twist[1] - twist[5] * p[0] + twist[3] * p[2]
    c = -twist[2] - twist[3] * p[1] + twist[4] * p[0]
    du, dv = fx * iz * (a - p[0] * iz * c), fy * iz * (b - p[1] * iz * c)
    E[:] = 0.0
    E[0, 0], E[1, 1], E[0, 2], E[1, 3], E[0, 9], E[1, 9] = x, y, 1.0, 1.0, du * row, dv * row
    E[2, 7], E[2, 8] = -1.0, -(x * x + y * y) / (0.25 * (width * width + height * height)) * iz
    E[2, 10], E[2, 11] = -c * iz * iz, -c * iz * iz * row
    if np.isfinite(plane[3]):
        s, t = plane[0] / (fx * plane[3]), plane[1] / (fy * plane[3])
        moved = s * du + t * dv
        E[2, 4], E[2, 5], E[2, 6] = s * x + t * y, s, t
        E[2, 9], E[2, 10], E[2, 11] = -moved * row, E[2, 10] + moved, E[2, 11] + moved * row


@kernel(forceinline=True)
def plane_point_error(p: F64, plane: F64, twist: F64, camera: F64, width: int, height: int, E: F64) -> None:
    """Fill E (12,): error (m) along a plane's normal of a point p (3,) on it, as depth and its ray give it, by each parameter in its own unit."""
    fx, fy, iz = camera[0], camera[1], 1.0 / p[2]
    x, y = fx * p[0] * iz, fy * p[1] * iz
    row = (y + camera[3]) / height - 0.5
    a = -twist[0] - twist[4] * p[2] + twist[5] * p[1]
    b = -twist[1] - twist[5] * p[0] + twist[3] * p[2]
    c = -twist[2] - twist[3] * p[1] + twist[4] * p[0]
    du, dv = fx * iz * (a - p[0] * iz * c), fy * iz * (b - p[1] * iz * c)
    g, k = plane[0] * p[2] / fx, plane[1] * p[2] / fy
    q = -p[2] * (plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2])
    E[0], E[1], E[2], E[3], E[4], E[5], E[6] = g * x, k * y, g, k, g * x + k * y, g, k
    E[7], E[8], E[9] = -q, -q * (x * x + y * y) / (0.25 * (width * width + height * height)) * iz, 0.0
    E[10] = g * du + k * dv - q * c * iz * iz
    E[11] = E[10] * row


@kernel(forceinline=True)
def _add(J: F64, W: F64, K: F64, r: F64, WJ: F64, WK: F64, total: Equations) -> None:
    """Add a residual r (3,) of information W (3, 3), with Jacobians J (3, 6) by the pose and K (3, 12) by the calibration; WJ and WK are overwritten
    with their products."""
    for i in range(3):
        for k in range(6):
            WJ[i, k] = W[i, 0] * J[0, k] + W[i, 1] * J[1, k] + W[i, 2] * J[2, k]
        for k in range(CALIBRATION):
            WK[i, k] = W[i, 0] * K[0, k] + W[i, 1] * K[1, k] + W[i, 2] * K[2, k]
    for a in range(6):
        total.b[a] += WJ[0, a] * r[0] + WJ[1, a] * r[1] + WJ[2, a] * r[2]
        for k in range(6):
            total.H[a, k] += J[0, a] * WJ[0, k] + J[1, a] * WJ[1, k] + J[2, a] * WJ[2, k]
        for k in range(CALIBRATION):
            total.C[a, k] += J[0, a] * WK[0, k] + J[1, a] * WK[1, k] + J[2, a] * WK[2, k]
    for a in range(CALIBRATION):
        total.s[a] += WK[0, a] * r[0] + WK[1, a] * r[1] + WK[2, a] * r[2]
        for k in range(CALIBRATION):
            total.G[a, k] += K[0, a] * WK[0, k] + K[1, a] * WK[1, k] + K[2, a] * WK[2, k]


@kernel(forceinline=True)
def to_keyframe(R: F64, t: F64, plane: F64, out: F64) -> None:
    """Move a plane (4,) of the world into the frame of a pose R, t."""
    out[3] = plane[3]
    for i in range(3):
        out[i] = R[0, i] * plane[0] + R[1, i] * plane[1] + R[2, i] * plane[2]
        out[3] += plane[i] * t[i]


@kernel(forceinline=True)
def to_observers(keyframes: Keyframes, observers: I32, plane: F64, out: F64) -> None:
    """Move a plane (4,) of the world into the frame of each of its observers, numbers of keyframes: (o, 4). Rows of -1 stay as they are."""
    for o in range(len(observers)):
        if observers[o] >= 0:
            to_keyframe(keyframes.R[observers[o]], keyframes.t[observers[o]], plane, out[o])


@kernel(forceinline=True)
def _add_view(
    q: F64, surface: F64, Q: F64, twist: F64, camera: F64, width: int, height: int, scales: F64, by_pixel: float, by_depth: float, moved: F64,
    E: F64, N: F64, V: F64,
) -> None:  # fmt: skip
    """Add the information that a keyframe's view of a landmark gives of its position in the camera's frame to N (3, 3), and its product with the
    error of that position by each parameter to V (3, 12).

    q (3,) is the landmark and `surface` (4,) its surface, both in the keyframe's frame, which Q turns to the camera's; pixels have the information
    `by_pixel`, and depth `by_depth`; the error of the keyframe's pose has `moved` (3, 12) the landmark. E (3, 12) is overwritten."""
    keypoint_errors(q, surface, twist, camera, width, height, E)
    iz, g = 1.0 / q[2], np.empty(3)
    for r in range(3):  # u, v, 1/z
        weight = by_pixel if r < 2 else by_depth / (iz * iz * iz * iz)
        for i in range(3):
            g[i] = camera[r] * iz * (Q[i, r] - q[r] * iz * Q[i, 2]) if r < 2 else -iz * iz * Q[i, 2]
        for i in range(3):
            for j in range(3):
                N[i, j] += weight * g[i] * g[j]
        for k in range(CALIBRATION):
            error = weight * (E[r, k] * scales[k] + g[0] * moved[0, k] + g[1] * moved[1, k] + g[2] * moved[2, k])
            for i in range(3):
                V[i, k] += g[i] * error


@kernel(forceinline=True)
def _point_calibration_jacobian(
    R: F64, world: F64, p: F64, surface: F64, observers: I32, keyframes: Keyframes, twist: F64, camera: F64, width: int, height: int,
    scales: F64, sigma_px: float, D: F64, K: F64,
) -> bool:  # fmt: skip
    """Fill K (3, 12), by parameters in units of `scales`: the error of a landmark that its observers placed, by pixels of `sigma_px` and their depth,
    less that of its measurement at p (3,) in the camera's frame. Returns False where no keyframe is known to have seen it."""
    q, then, Q, E, moved = np.empty(3), np.empty(4), np.empty((3, 3)), np.empty((3, CALIBRATION)), np.empty((3, CALIBRATION))
    N, V, M, seen = np.zeros((3, 3)), np.zeros((3, CALIBRATION)), np.empty((3, 3)), False
    for k in observers:
        if k < 0:
            continue
        to_camera(keyframes.R[k], keyframes.t[k], world, q)
        if not q[2] > NEAR_M:
            continue
        rotation_between(R, keyframes.R[k], Q)
        _plane_then(surface, Q, p, q, then)
        for c in range(CALIBRATION):
            x, y, z = keyframes.errors[k, 3, c], keyframes.errors[k, 4, c], keyframes.errors[k, 5, c]
            moved[0, c] = keyframes.errors[k, 0, c] + y * p[2] - z * p[1]
            moved[1, c] = keyframes.errors[k, 1, c] + z * p[0] - x * p[2]
            moved[2, c] = keyframes.errors[k, 2, c] + x * p[1] - y * p[0]
        by_pixel, by_depth = 1.0 / sigma_px**2, 1.0 / sigma_z(q[2], keyframes.noise) ** 2
        _add_view(q, then, Q, keyframes.twists[k], camera, width, height, scales, by_pixel, by_depth, moved, E, N, V)
        seen = True
    if not seen:
        return False
    invert_symmetric(N, M)
    keypoint_errors(p, surface, twist, camera, width, height, E)
    rows = 3 if D[2, 2] != 0.0 else 2
    for i in range(3):
        for b in range(3):
            Q[i, b] = D[i, 0] * M[0, b] + D[i, 1] * M[1, b] + D[i, 2] * M[2, b]
        for k in range(CALIBRATION):
            K[i, k] = Q[i, 0] * V[0, k] + Q[i, 1] * V[1, k] + Q[i, 2] * V[2, k] - (E[i, k] * scales[k] if i < rows else 0.0)
    return True


@kernel(forceinline=True)
def _plane_then(surface: F64, Q: F64, p: F64, q: F64, out: F64) -> None:
    """Move the plane of a point from the camera's frame, where the point is p, into its keyframe's, where it is q; NaN through the centre."""
    out[3] = surface[3]
    for a in range(3):
        out[a] = Q[0, a] * surface[0] + Q[1, a] * surface[1] + Q[2, a] * surface[2]
        out[3] += surface[a] * p[a]
    out[3] -= out[0] * q[0] + out[1] * q[1] + out[2] * q[2]
    if not abs(out[3]) > NEAR_M:
        out[3] = np.nan


@kernel
def _add_points(
    R: F64, t: F64, camera: F64, width: int, height: int, scales: F64, twist: F64, points: PointTerms, W: F64, flags: U8, surfaces: F64,
    observers: I32, keyframes: Keyframes, total: Equations,
) -> None:  # fmt: skip
    """Add the inliers among the points; `surfaces` (n, 4) are the planes that they lie on, in the camera frame (NaN: none)."""
    p, r, D, J = np.empty(3), np.empty(3), np.zeros((3, 3)), np.empty((3, 6))
    K, WJ, WK = np.empty((3, CALIBRATION)), np.empty((3, 6)), np.empty((3, CALIBRATION))
    for i in range(len(flags)):
        if not flags[i]:
            continue
        world = points.positions_m[i]
        to_camera(R, t, world, p)
        if not point_residual(p, points.pixels[i], points.depth_m[i], camera, r, D):
            continue
        if _point_calibration_jacobian(
            R, world, p, surfaces[i], observers[i], keyframes, twist, camera, width, height, scales, points.sigma_px[i], D, K
        ):
            pose_jacobian(D, 3, p, J)
            _add(J, W[i], K, r, WJ, WK, total)


@kernel(forceinline=True)
def add_placed_error(
    q: F64, surface: F64, p: F64, Q: F64, of_pose: F64, twist: F64, camera: F64, width: int, height: int, scales: F64, weight: float, E: F64,
    out: F64,
) -> None:  # fmt: skip
    """Add to `out` (3, 12), times a weight, the error in the camera's frame of a point that a keyframe placed by its pixel and its depth there.

    The point is q (3,) on a `surface` (4,) (NaN: not known; its slope is then left out) in the keyframe's frame, which Q turns to the camera's, where
    it is p (3,); `of_pose` (6, 12) is the error of the keyframe's pose. E (3, 12) is overwritten."""
    keypoint_errors(q, surface, twist, camera, width, height, E)
    z = q[2]
    for c in range(CALIBRATION):
        w = -z * E[2, c]
        x, y, w = z / camera[0] * E[0, c] + w * q[0], z / camera[1] * E[1, c] + w * q[1], w * z
        a, b, d = of_pose[3, c], of_pose[4, c], of_pose[5, c]
        out[0, c] += weight * (scales[c] * (Q[0, 0] * x + Q[0, 1] * y + Q[0, 2] * w) + of_pose[0, c] + b * p[2] - d * p[1])
        out[1, c] += weight * (scales[c] * (Q[1, 0] * x + Q[1, 1] * y + Q[1, 2] * w) + of_pose[1, c] + d * p[0] - a * p[2])
        out[2, c] += weight * (scales[c] * (Q[2, 0] * x + Q[2, 1] * y + Q[2, 2] * w) + of_pose[2, c] + a * p[1] - b * p[0])


@kernel(forceinline=True)
def _line_end_error(
    R: F64, t: F64, world: F64, p: F64, surface: F64, observers: I32, keyframes: Keyframes, twist: F64, camera: F64, width: int, height: int,
    scales: F64, E: F64, out: F64,
) -> bool:  # fmt: skip
    """Fill `out` (3, 12): the mean error of the end of a line that its observers placed, weighted by the noise of their depth, less that of its
    measurement; p (3,) is the end in the camera's frame, on a `surface` (4,). Returns False where the camera, or all observers, do not have it in
    their image."""
    q, then, Q, weights = np.empty(3), np.empty(4), np.empty((3, 3)), 0.0
    out[:] = 0.0
    if not in_view(p, camera, width, height):
        return False
    for k in observers:
        if k < 0:
            continue
        to_camera(keyframes.R[k], keyframes.t[k], world, q)
        if not in_view(q, camera, width, height):
            continue
        rotation_between(R, keyframes.R[k], Q)
        _plane_then(surface, Q, p, q, then)
        weight = 1.0 / sigma_z(q[2], keyframes.noise) ** 2
        add_placed_error(q, then, p, Q, keyframes.errors[k], keyframes.twists[k], camera, width, height, scales, weight, E, out)
        weights += weight
    if weights == 0.0:
        return False
    out /= weights
    add_placed_error(p, surface, p, np.eye(3), np.zeros((6, CALIBRATION)), twist, camera, width, height, scales, -1.0, E, out)
    return True


@kernel
def _add_lines(
    R: F64, t: F64, camera: F64, width: int, height: int, scales: F64, twist: F64, lines: LineTerms, W: F64, V: F64, flags: U8, surfaces: F64,
    observers: I32, keyframes: Keyframes, total: Equations,
) -> None:  # fmt: skip
    """Add the inliers among the lines: the distances of their ends in the image, of information W (m, 2, 2), and those in depth, V (m, 2, 2).
    `surfaces` (m, 2, 4) are the planes that their ends lie on, in the camera frame (NaN: none)."""
    p, D, m, E = np.empty((2, 3)), np.empty(3), np.empty(3), np.empty((3, CALIBRATION))
    error, J, K, r = np.empty((2, 3, CALIBRATION)), np.empty((2, 6)), np.empty((2, CALIBRATION)), np.empty(2)
    for i in range(len(flags)):
        if not flags[i]:
            continue
        known = True
        for end in range(2):
            world = lines.endpoints_m[i, end]
            to_camera(R, t, world, p[end])
            known = known and _line_end_error(
                R, t, world, p[end], surfaces[i, end], observers[i], keyframes, twist, camera, width, height, scales, E, error[end]
            )  # fmt: skip
        if not known:
            continue
        for end in range(2):
            r[end] = line_residual(p[end], lines.endpoints_px[i], camera, D)[0]
            pose_jacobian_row(D[0], D[1], D[2], p, end, J)
            for c in range(CALIBRATION):
                K[end, c] = D[0] * error[end, 0, c] + D[1] * error[end, 1, c] + D[2] * error[end, 2, c]
        _add_pair(J, W[i], K, total.H, total.C)
        _add_evidence(J, W[i], K, r, total)
        if flags[i] == INLIER and depth_direction(lines.observed_m[i], m):
            for end in range(2):
                pose_jacobian_row(m[0], m[1], m[2], p, end, J)
                for c in range(CALIBRATION):
                    K[end, c] = m[0] * error[end, 0, c] + m[1] * error[end, 1, c] + m[2] * error[end, 2, c]
            _add_pair(J, V[i], K, total.H_depth, total.C_depth)


@kernel(forceinline=True)
def _add_pair(J: F64, W: F64, K: F64, H: F64, C: F64) -> None:
    """Add two residuals of information W (2, 2), with Jacobians J (2, 6) by the pose and K (2, 12) by the calibration, to H and C."""
    for a in range(6):
        x, y = J[0, a] * W[0, 0] + J[1, a] * W[1, 0], J[0, a] * W[0, 1] + J[1, a] * W[1, 1]
        for k in range(6):
            H[a, k] += x * J[0, k] + y * J[1, k]
        for k in range(CALIBRATION):
            C[a, k] += x * K[0, k] + y * K[1, k]


@kernel(forceinline=True)
def _add_evidence(J: F64, W: F64, K: F64, r: F64, total: Equations) -> None:
    """Add the same residuals r (2,) to b, G and s."""
    x, y = W[0, 0] * r[0] + W[0, 1] * r[1], W[1, 0] * r[0] + W[1, 1] * r[1]
    for a in range(6):
        total.b[a] += J[0, a] * x + J[1, a] * y
    for a in range(CALIBRATION):
        total.s[a] += K[0, a] * x + K[1, a] * y
        v, w = K[0, a] * W[0, 0] + K[1, a] * W[1, 0], K[0, a] * W[0, 1] + K[1, a] * W[1, 1]
        for k in range(CALIBRATION):
            total.G[a, k] += v * K[0, k] + w * K[1, k]


@kernel(forceinline=True)
def in_view(p: F64, camera: F64, width: int, height: int) -> bool:
    """Return True for a point p (3,) of the camera's frame that the camera has in its image."""
    if not p[2] > NEAR_M:
        return False
    u, v = camera[0] * p[0] / p[2] + camera[2], camera[1] * p[1] / p[2] + camera[3]
    return bool(0.0 <= u < width and 0.0 <= v < height)


@kernel(forceinline=True)
def distance_jacobian(plane: F64, p: F64, J: F64) -> None:
    """Fill J (6,): derivative of the distance of a point p (3,) from a plane (4,) by the pose that it is seen from, both in its frame."""
    J[0], J[1], J[2] = plane[0], plane[1], plane[2]
    J[3], J[4], J[5] = p[1] * plane[2] - p[2] * plane[1], p[2] * plane[0] - p[0] * plane[2], p[0] * plane[1] - p[1] * plane[0]


@kernel(forceinline=True)
def placed_distance_error(
    point: F64, J: F64, observers: I32, keyframes: Keyframes, then: F64, camera: F64, width: int, height: int, scales: F64, q: F64, E: F64, out: F64
) -> bool:
    """Fill `out` (12,), by parameters in units of `scales`: the mean error of the distance of a point (3,) of the world from the plane that
    `observers` placed, weighted by the noise of their depth. `then` (o, 4) is the plane in their frames, and J (6,) `distance_jacobian` in the
    camera's; q (3,) and E (12,) are overwritten. Returns False where none of them had the point in its image."""
    out[:], weights = 0.0, 0.0
    for o in range(len(observers)):
        k = observers[o]
        if k < 0:
            continue
        to_camera(keyframes.R[k], keyframes.t[k], point, q)
        if not in_view(q, camera, width, height):
            continue
        plane_point_error(q, then[o], keyframes.twists[k], camera, width, height, E)
        weight = 1.0 / sigma_z(q[2], keyframes.noise) ** 2
        for c in range(CALIBRATION):
            error = E[c] * scales[c]
            for a in range(6):
                error += J[a] * keyframes.errors[k, a, c]
            out[c] += weight * error
        weights += weight
    if weights == 0.0:
        return False
    for c in range(CALIBRATION):
        out[c] /= weights
    return True


@kernel
def _plane_calibration_jacobian(
    R: F64, t: F64, plane: F64, samples: F32, observers: I32, keyframes: Keyframes, twist: F64, camera: F64, width: int, height: int,
    scales: F64, B: F64, K: F64,
) -> bool:  # fmt: skip
    """Fill K (3, 12), by parameters in units of `scales`: what the calibration does to a plane (4,) as measured, less what it did to the map's, which
    its observers placed, fitted to what it does to those of its samples (n, 3) that are in view of the camera and of an observer. Returns False for
    too few of them. B (3, 2) are the tangents of its residual."""
    p, q, then, J = np.empty(3), np.empty(3), np.empty((len(observers), 4)), np.empty(6)
    now, E, mean, row = np.empty(4), np.empty(CALIBRATION), np.empty(CALIBRATION), np.ones(3)
    to_keyframe(R, t, plane, now)
    to_observers(keyframes, observers, plane, then)
    N, X, seen = np.zeros((3, 3)), np.zeros((3, CALIBRATION)), 0
    for j in range(len(samples)):
        point = samples[j].astype(np.float64)
        to_camera(R, t, point, p)
        if not in_view(p, camera, width, height):
            continue
        distance_jacobian(now, p, J)
        if not placed_distance_error(point, J, observers, keyframes, then, camera, width, height, scales, q, E, mean):
            continue
        seen += 1
        plane_point_error(p, now, twist, camera, width, height, E)
        row[0], row[1] = B[0, 0] * p[0] + B[1, 0] * p[1] + B[2, 0] * p[2], B[0, 1] * p[0] + B[1, 1] * p[1] + B[2, 1] * p[2]
        for a in range(3):
            for b in range(3):
                N[a, b] += row[a] * row[b]
            for c in range(CALIBRATION):
                X[a, c] += row[a] * (E[c] * scales[c] - mean[c])
    if seen < LEAST_SAMPLES:
        return False
    copy_matrix(matmul(inverse_positive(N), X), K)
    return True


@kernel
def _add_planes(
    R: F64, t: F64, camera: F64, width: int, height: int, scales: F64, twist: F64, planes: PlaneTerms, W: F64, flags: U8, samples: F32,
    observers: I32, keyframes: Keyframes, total: Equations,
) -> None:  # fmt: skip
    """Add the inliers among the identical planes, the first of the planes; `samples` (p, n, 3) are points on them, world."""
    r, B, J = np.empty(3), np.empty((3, 2)), np.empty((3, 6))
    K, WJ, WK = np.empty((3, CALIBRATION)), np.empty((3, 6)), np.empty((3, CALIBRATION))
    for i in range(len(samples)):
        if not flags[i]:
            continue
        plane = planes.coefficients[i]
        tangent_columns(planes.observed[i], B)
        plane_residual(np.int32(SAME), R, t, plane, planes.observed[i], B, r, J)
        if _plane_calibration_jacobian(R, t, plane, samples[i], observers[i], keyframes, twist, camera, width, height, scales, B, K):
            _add(J, W[i], K, r, WJ, WK, total)


@kernel
def calibration_equations(
    T: F64, camera: F64, width: int, height: int, scales: F64, twist: F64, points: PointTerms, lines: LineTerms, planes: PlaneTerms, flags: Flags,
    surfaces: Surfaces, samples: F32, observers: Observers, keyframes: Keyframes,
) -> Equations:  # fmt: skip
    """Normal equations of the inliers among points, lines and identical planes at the pose T (4, 4), for parameters in units of `scales` (12,)."""
    R, t = split_pose(T)
    total = Equations(
        np.zeros((6, 6)), np.zeros(6), np.zeros((6, CALIBRATION)), np.zeros((CALIBRATION, CALIBRATION)), np.zeros(CALIBRATION),
        np.zeros((6, 6)), np.zeros((6, CALIBRATION)),
    )  # fmt: skip
    n, m, p = len(points.positions_m), len(lines.endpoints_m), len(planes.kinds)
    weights = Weights(np.empty((n, 3, 3)), np.empty((m, 2, 2)), np.empty((m, 2, 2)), np.empty((p, 3, 3)))
    fill_weights(R, t, camera, points, lines, planes, weights)
    _add_points(R, t, camera, width, height, scales, twist, points, weights.points, flags.points, surfaces.points, observers.points, keyframes, total)
    _add_lines(
        R, t, camera, width, height, scales, twist, lines, weights.lines, weights.line_depths, flags.lines, surfaces.lines, observers.lines,
        keyframes, total,
    )  # fmt: skip
    _add_planes(R, t, camera, width, height, scales, twist, planes, weights.planes, flags.planes, samples, observers.planes, keyframes, total)
    return total


@kernel
def moved_sensitivity(T: F64, previous: F64, sensitivity: F64) -> F64:
    """Return the error of a pose T (4, 4) by the calibration (6, 12) as it is for a camera that moved there with the `previous` one."""
    adjoint = np.empty((6, 6))
    adjoint_between(T, previous, adjoint)
    return matmul(adjoint, sensitivity)


@kernel
def keyframes_at(T: F64, poses: F64, twists: F64, sensitivities: F64, noise: tuple[float, float, float, float]) -> Keyframes:
    """Return keyframes with poses (m, 4, 4), velocities (m, 6) and errors by the calibration (m, 6, 12) of their own, and a noise of depth, for a
    camera at T (4, 4)."""
    R, t, errors = np.empty((len(poses), 3, 3)), np.empty((len(poses), 3)), np.empty(sensitivities.shape)
    for k in range(len(poses)):
        for i in range(3):
            t[k, i] = poses[k, i, 3]
            for j in range(3):
                R[k, i, j] = poses[k, i, j]
        copy_matrix(moved_sensitivity(T, poses[k], sensitivities[k]), errors[k])
    return Keyframes(R, t, twists, errors, noise)


@kernel
def sensitivity_and_evidence(equations: Equations, prior: F64, before: F64) -> tuple[F64, F64, F64]:
    """Return the error of a pose by the calibration (6, 12), `before` being that of its prior of information `prior` (6, 6); and the information
    (12, 12) and score (12,) on the calibration that the residuals leave beside the pose. Errors that the prior and all keyframes have in common leave
    no residual, and give none."""
    to_pose, carried = inverse_positive(equations.H + prior), matmul(prior, before)
    cross = equations.C - carried
    share = matmul(to_pose, cross)
    information, score = equations.G + matmul(before.T.copy(), carried), equations.s.copy()
    for a in range(CALIBRATION):
        for i in range(6):
            score[a] -= share[i, a] * equations.b[i]
            for k in range(CALIBRATION):
                information[a, k] -= 0.5 * (share[i, a] * cross[i, k] + cross[i, a] * share[i, k])
    to_pose = inverse_positive(equations.H + equations.H_depth + prior)
    return -matmul(to_pose, cross + equations.C_depth), information, score


@kernel
def calibration_moment(information: F64, score: F64) -> F64:
    """Second moment (12, 12) of the parameters given the evidence of residuals, `information` (12, 12) and `score` (12,): the covariance, and the
    square of the mean, which nothing is corrected by.

    They are independent with a common variance v, which is 1 as stated, or more where expectation maximisation (MacKay, Neural Computation 1992)
    finds that the residuals ask for it."""
    v = 1.0
    for _ in range(EXPECTATIONS + 1):
        covariance, trace, square = information.copy(), 0.0, 0.0
        for k in range(CALIBRATION):
            covariance[k, k] += 1.0 / v
        covariance = inverse_positive(covariance)
        mean = matvec(covariance, score)
        for k in range(CALIBRATION):
            trace, square = trace + covariance[k, k], square + mean[k] * mean[k]
        v = max(1.0, (PRIOR_COUNT + trace + square) / (PRIOR_COUNT + CALIBRATION))
    for i in range(CALIBRATION):
        for j in range(CALIBRATION):
            covariance[i, j] += mean[i] * mean[j]
    return covariance
