"""Kernels of `calibration_error.py`: what residuals tell of the calibration, and its second moments.

A measurement errs by `M θ`: `keypoint_errors` in the image and in inverse depth, `plane_point_error` along a plane's normal. A landmark was placed by
the same camera from the keyframes that observed it, and errs with their mean. A residual shows the difference, and the keyframes' own errors."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import add_matrix, copy_matrix, inverse_positive, matmul, matvec, split_pose, tangent_columns
from trihedron.pipeline.core.types import CALIBRATION, F32, F64, I32, U8
from trihedron.plugins.shared.lie_kernels import adjoint_between
from trihedron.plugins.shared.pose_optimizer_kernels import Flags
from trihedron.plugins.shared.residuals_kernels import (
    NEAR_M,
    SAME,
    LineTerms,
    PlaneTerms,
    PointTerms,
    Weights,
    fill_weights,
    plane_residual,
    point_residual,
    pose_jacobian,
    to_camera,
)

EXPECTATIONS = 8  # iterations for the common scale
PRIOR_COUNT = 4.0  # parameters that the prior of the common scale counts as
LEAST_SAMPLES = 4  # of a plane in both views, from which on it informs on the calibration


class Keyframes(NamedTuple):
    """The m keyframes that observed landmarks: rotations and positions of `T_world_keyframe`, velocities, and errors by the calibration as those of
    xi of the camera."""

    R: F64  # (m, 3, 3)
    t: F64  # (m, 3)
    twists: F64  # (m, 6)
    errors: F64  # (m, 6, 12)


class Observers(NamedTuple):
    """Numbers of the keyframes that observed each point (n, o) and each identical plane (p, o), which are the first of the planes; -1 for none."""

    points: I32
    planes: I32


class Equations(NamedTuple):
    """Normal equations by the pose, H (6, 6) and b (6,), and by the calibration, G (12, 12) and s (12,), with C (6, 12) between them."""

    H: F64
    b: F64
    C: F64
    G: F64
    s: F64


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
def _scale_and_subtract(scales: F64, J: F64, A: F64, K: F64) -> None:
    """Express K (3, 12) in units of `scales`; and subtract J A, since a landmark moves with the keyframes that observed it, whose mean error by the
    calibration is A (6, 12) as that of the camera."""
    for i in range(3):
        for k in range(CALIBRATION):
            moved = J[i, 0] * A[0, k] + J[i, 1] * A[1, k] + J[i, 2] * A[2, k] + J[i, 3] * A[3, k] + J[i, 4] * A[4, k] + J[i, 5] * A[5, k]
            K[i, k] = K[i, k] * scales[k] - moved


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
def _add_point_error(q: F64, of_plane: F64, Q: F64, twist: F64, camera: F64, width: int, height: int, D: F64, E: F64, K: F64) -> None:
    """Add `D Q dq/dθ` to K (3, 12): the error of a landmark as a keyframe saw it, q (3,) in its frame, with Q from that frame to the camera's and
    D = dr/dp; `of_plane` (4,) is the surface there. E (3, 12) is overwritten."""
    keypoint_errors(q, of_plane, twist, camera, width, height, E)
    for i in range(3):  # D Q dq/d(u, v, 1/z)
        x, y, z = 0.0, 0.0, 0.0
        for j in range(3):
            x, y, z = x + D[i, j] * Q[j, 0], y + D[i, j] * Q[j, 1], z + D[i, j] * Q[j, 2]
        u, v, w = x * q[2] / camera[0], y * q[2] / camera[1], -q[2] * (x * q[0] + y * q[1] + z * q[2])
        for k in range(CALIBRATION):
            K[i, k] += u * E[0, k] + v * E[1, k] + w * E[2, k]


@kernel(forceinline=True)
def _point_calibration_jacobian(
    R: F64, world: F64, p: F64, surface: F64, observers: I32, keyframes: Keyframes, twist: F64, camera: F64, width: int, height: int,
    D: F64, K: F64, A: F64,
) -> bool:  # fmt: skip
    """Fill K (3, 12): the mean error of a landmark over its observers, less that of its measurement at p (3,) in the camera's frame; and A (6, 12),
    the observers' mean error. Returns False where no keyframe is known to have seen it."""
    q, then, Q, E = np.empty(3), np.empty(4), np.empty((3, 3)), np.empty((3, CALIBRATION))
    K[:], A[:], seen = 0.0, 0.0, 0
    for k in observers:
        if k < 0:
            continue
        to_camera(keyframes.R[k], keyframes.t[k], world, q)
        if not q[2] > NEAR_M:
            continue
        for a in range(3):
            for b in range(3):
                Q[a, b] = R[0, a] * keyframes.R[k, 0, b] + R[1, a] * keyframes.R[k, 1, b] + R[2, a] * keyframes.R[k, 2, b]
        _plane_then(surface, Q, p, q, then)
        _add_point_error(q, then, Q, keyframes.twists[k], camera, width, height, D, E, K)
        add_matrix(keyframes.errors[k], A)
        seen += 1
    if seen == 0:
        return False
    keypoint_errors(p, surface, twist, camera, width, height, E)
    rows = 3 if D[2, 2] != 0.0 else 2
    for i in range(3):
        for k in range(CALIBRATION):
            K[i, k] = K[i, k] / seen - (E[i, k] if i < rows else 0.0)
    A /= seen
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
    K, A, WJ, WK = np.empty((3, CALIBRATION)), np.empty((6, CALIBRATION)), np.empty((3, 6)), np.empty((3, CALIBRATION))
    for i in range(len(flags)):
        if not flags[i]:
            continue
        world = points.positions_m[i]
        to_camera(R, t, world, p)
        if not point_residual(p, points.pixels[i], points.depth_m[i], camera, r, D):
            continue
        if _point_calibration_jacobian(R, world, p, surfaces[i], observers[i], keyframes, twist, camera, width, height, D, K, A):
            pose_jacobian(D, 3, p, J)
            _scale_and_subtract(scales, J, A, K)
            _add(J, W[i], K, r, WJ, WK, total)


@kernel(forceinline=True)
def in_view(p: F64, camera: F64, width: int, height: int) -> bool:
    """Return True for a point p (3,) of the camera's frame that the camera has in its image."""
    if not p[2] > NEAR_M:
        return False
    u, v = camera[0] * p[0] / p[2] + camera[2], camera[1] * p[1] / p[2] + camera[3]
    return bool(0.0 <= u < width and 0.0 <= v < height)


@kernel
def _plane_calibration_jacobian(
    R: F64, t: F64, plane: F64, samples: F32, observers: I32, keyframes: Keyframes, twist: F64, camera: F64, width: int, height: int,
    B: F64, K: F64, A: F64,
) -> bool:  # fmt: skip
    """Fill K (3, 12): what the calibration does to a plane (4,), fitted to what it does to those of its samples (n, 3) that are in view of the camera
    and of an observer; and A (6, 12), the observers' mean error. Returns False for too few of them. B (3, 2) are the tangents of its residual."""
    p, q, then = np.empty(3), np.empty(3), np.empty((len(observers), 4))
    now, E, F, mean, row = np.empty(4), np.empty(CALIBRATION), np.empty(CALIBRATION), np.empty(CALIBRATION), np.ones(3)
    to_keyframe(R, t, plane, now)
    to_observers(keyframes, observers, plane, then)
    N, X, seen, total = np.zeros((3, 3)), np.zeros((3, CALIBRATION)), 0, 0
    A[:] = 0.0
    for j in range(len(samples)):
        point = samples[j].astype(np.float64)
        to_camera(R, t, point, p)
        if not in_view(p, camera, width, height):
            continue
        mean[:], count = 0.0, 0
        for o in range(len(observers)):
            k = observers[o]
            if k < 0:
                continue
            to_camera(keyframes.R[k], keyframes.t[k], point, q)
            if not in_view(q, camera, width, height):
                continue
            plane_point_error(q, then[o], keyframes.twists[k], camera, width, height, E)
            for c in range(CALIBRATION):
                mean[c] += E[c]
            add_matrix(keyframes.errors[k], A)
            count += 1
        if count == 0:
            continue
        seen, total = seen + 1, total + count
        plane_point_error(p, now, twist, camera, width, height, F)
        row[0], row[1] = B[0, 0] * p[0] + B[1, 0] * p[1] + B[2, 0] * p[2], B[0, 1] * p[0] + B[1, 1] * p[1] + B[2, 1] * p[2]
        for a in range(3):
            for b in range(3):
                N[a, b] += row[a] * row[b]
            for c in range(CALIBRATION):
                X[a, c] += row[a] * (F[c] - mean[c] / count)
    if seen < LEAST_SAMPLES:
        return False
    copy_matrix(matmul(inverse_positive(N), X), K)
    A /= total
    return True


@kernel
def _add_planes(
    R: F64, t: F64, camera: F64, width: int, height: int, scales: F64, twist: F64, planes: PlaneTerms, W: F64, flags: U8, samples: F32,
    observers: I32, keyframes: Keyframes, total: Equations,
) -> None:  # fmt: skip
    """Add the inliers among the identical planes, the first of the planes; `samples` (p, n, 3) are points on them, world."""
    r, B, J = np.empty(3), np.empty((3, 2)), np.empty((3, 6))
    K, A, WJ, WK = np.empty((3, CALIBRATION)), np.empty((6, CALIBRATION)), np.empty((3, 6)), np.empty((3, CALIBRATION))
    for i in range(len(samples)):
        if not flags[i]:
            continue
        plane = planes.coefficients[i]
        tangent_columns(planes.observed[i], B)
        plane_residual(np.int32(SAME), R, t, plane, planes.observed[i], B, r, J)
        if _plane_calibration_jacobian(R, t, plane, samples[i], observers[i], keyframes, twist, camera, width, height, B, K, A):
            _scale_and_subtract(scales, J, A, K)
            _add(J, W[i], K, r, WJ, WK, total)


@kernel
def calibration_equations(
    T: F64, camera: F64, width: int, height: int, scales: F64, twist: F64, points: PointTerms, planes: PlaneTerms, flags: Flags, surfaces: F64,
    samples: F32, observers: Observers, keyframes: Keyframes,
) -> Equations:  # fmt: skip
    """Normal equations of the inliers among points and identical planes at the pose T (4, 4), for parameters in units of `scales` (12,)."""
    R, t = split_pose(T)
    total = Equations(
        np.zeros((6, 6)), np.zeros(6), np.zeros((6, CALIBRATION)), np.zeros((CALIBRATION, CALIBRATION)), np.zeros(CALIBRATION)
    )  # fmt: skip
    no_lines = LineTerms(
        np.empty((0, 2, 3)), np.empty((0, 2, 3, 3)), np.empty((0, 2, 2)), np.empty(0), np.empty((0, 2, 3)), np.empty((0, 2, 3, 3))
    )  # fmt: skip
    n, p = len(points.positions_m), len(planes.kinds)
    weights = Weights(np.empty((n, 3, 3)), np.empty((0, 2, 2)), np.empty((0, 2, 2)), np.empty((p, 3, 3)))
    fill_weights(R, t, camera, points, no_lines, planes, weights)
    _add_points(R, t, camera, width, height, scales, twist, points, weights.points, flags.points, surfaces, observers.points, keyframes, total)
    _add_planes(R, t, camera, width, height, scales, twist, planes, weights.planes, flags.planes, samples, observers.planes, keyframes, total)
    return total


@kernel
def moved_sensitivity(T: F64, previous: F64, sensitivity: F64) -> F64:
    """Return the error of a pose T (4, 4) by the calibration (6, 12) as it is for a camera that moved there with the `previous` one."""
    adjoint = np.empty((6, 6))
    adjoint_between(T, previous, adjoint)
    return matmul(adjoint, sensitivity)


@kernel
def keyframes_at(T: F64, poses: F64, twists: F64, sensitivities: F64) -> Keyframes:
    """Return keyframes with poses (m, 4, 4), velocities (m, 6) and errors by the calibration (m, 6, 12) of their own, for a camera at T (4, 4)."""
    R, t, errors = np.empty((len(poses), 3, 3)), np.empty((len(poses), 3)), np.empty(sensitivities.shape)
    for k in range(len(poses)):
        for i in range(3):
            t[k, i] = poses[k, i, 3]
            for j in range(3):
                R[k, i, j] = poses[k, i, j]
        copy_matrix(moved_sensitivity(T, poses[k], sensitivities[k]), errors[k])
    return Keyframes(R, t, twists, errors)


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
    return -share, information, score


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
