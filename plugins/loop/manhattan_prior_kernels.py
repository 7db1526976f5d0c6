"""Kernels of `manhattan_prior.py`: rotations of keyframes from the directions of their landmarks, and their errors by the calibration."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import copy_matrix, dot, inverse_positive, matmul, matvec, solve, split_pose, tangent_columns
from trihedron.pipeline.core.types import CALIBRATION, F32, F64, I32
from trihedron.plugins.shared.calibration_error_kernels import (
    LEAST_SAMPLES,
    Keyframes,
    add_placed_error,
    distance_jacobian,
    in_view,
    keyframes_at,
    placed_distance_error,
    to_keyframe,
    to_observers,
)
from trihedron.plugins.shared.depth_image_kernels import sigma_z
from trihedron.plugins.shared.residuals_kernels import to_camera

LINE_SAMPLES = 9  # along a line, of which the outermost in an image are its part of it


@kernel
def keyframe_rotations(
    vectors: F64, information: F64, turns: F64, keyframes: I32, R_world_manhattan: F64, poses: F64, least_cos: float, gate: float
) -> tuple[F64, F64, F64]:
    """Estimate rotations (k, 3), information (k, 3, 3) and sensitivity (k, 3, 12), see `ManhattanPrior`, from world directions (n, 3) with their
    information, observed by the keyframes `keyframes` (n,), and `turns` (n, 3, 12), by which the calibration turns them in these keyframes' frames.

    A direction v and its axis e, both in the camera: `v - Exp(-phi) e = v - e + phi × e` to first order; Cauchy's weights."""
    k = len(poses)
    H, g, rotations = np.zeros((k, 3, 3)), np.zeros((k, 3)), np.zeros((k, 3))
    G, sensitivity = np.zeros((k, 3, CALIBRATION)), np.zeros((k, 3, CALIBRATION))
    S, axis, regular = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(len(vectors)):
        along, nearest = matvec(R_world_manhattan.T, vectors[i]), 0
        for a in range(1, 3):
            if abs(along[a]) > abs(along[nearest]):
                nearest = a
        if not abs(along[nearest]) > least_cos:  # NaN too
            continue
        for a in range(3):
            axis[a] = R_world_manhattan[a, nearest] * np.sign(along[nearest])
        R, _ = split_pose(poses[keyframes[i]])
        e, r = matvec(R.T, axis), matvec(R.T, vectors[i])
        for a in range(3):
            r[a] -= e[a]
        S[0, 1], S[0, 2], S[1, 0], S[1, 2], S[2, 0], S[2, 1] = e[2], -e[1], -e[2], e[0], e[1], -e[0]  # phi × e = S phi
        A = matmul(matmul(R.T, information[i]), R)
        Ar = matvec(A, r)
        weight, SAS, SAr = 1.0 / (1.0 + dot(r, Ar) / gate**2), matmul(matmul(S.T, A), S), matvec(S.T, Ar)
        for a in range(3):
            g[keyframes[i], a] -= weight * SAr[a]
            for b in range(3):
                H[keyframes[i], a, b] += weight * SAS[a, b]
                for c in range(CALIBRATION):
                    G[keyframes[i], a, c] += weight * SAS[a, b] * turns[i, b, c]
    for j in range(k):
        copy_matrix(H[j], regular)
        for a in range(3):
            regular[a, a] += 1e-2
        small = solve(regular, g[j])
        rotations[j, 0], rotations[j, 1], rotations[j, 2] = small[0], small[1], small[2]
        copy_matrix(matmul(inverse_positive(regular), G[j]), sensitivity[j])
    return rotations, H, sensitivity


class Views(NamedTuple):
    """The k keyframes of a map: poses `T_world_keyframe`, velocities, errors of the poses by the calibration, and their camera: intrinsics
    (fx, fy, cx, cy), size, units of the parameters, and noise of depth (`DepthNoise.coefficients`)."""

    poses: F64  # (k, 4, 4)
    twists: F64  # (k, 6)
    sensitivities: F64  # (k, 6, 12)
    camera: F64  # (4,)
    width: int
    height: int
    scales: F64  # (12,)
    noise: tuple[float, float, float, float]


@kernel
def _observers_at(views: Views, T: F64, observers: I32) -> Keyframes:
    """The keyframes among `observers` (o,), numbers or -1, for a camera at T (4, 4)."""
    rows, count = np.empty(len(observers), np.int32), 0
    for k in observers:
        if k >= 0:
            rows[count] = k
            count += 1
    rows = rows[:count]
    return keyframes_at(T, views.poses[rows], views.twists[rows], views.sensitivities[rows], views.noise)


@kernel(forceinline=True)
def _fill_turn(direction: F64, change: F64, out: F64) -> None:
    """Fill the rotation vectors (3, m) across a unit direction (3,) that change it by the columns of `change` (3, m)."""
    for c in range(change.shape[1]):
        out[0, c] = direction[1] * change[2, c] - direction[2] * change[1, c]
        out[1, c] = direction[2] * change[0, c] - direction[0] * change[2, c]
        out[2, c] = direction[0] * change[1, c] - direction[1] * change[0, c]


@kernel
def plane_turns(planes: F64, samples: F32, observers: I32, middle: I32, views: Views) -> F64:
    """Return the rotation vectors (p, 3, 12) by which errors of the calibration turn planes (p, 4) of the world, each in the frame of its `middle`
    observer (p,), about axes in the plane: they are where their observers (p, o), numbers of keyframes or -1, placed their `samples` (p, s, 3).
    A plane of too few samples turns as its middle observer does."""
    turns, p, q, J, row = np.zeros((len(planes), 3, CALIBRATION)), np.empty(3), np.empty(3), np.empty(6), np.ones(3)
    B, now, E, error = np.empty((3, 2)), np.empty(4), np.empty(CALIBRATION), np.empty(CALIBRATION)
    camera, width, height = views.camera, views.width, views.height
    for i in range(len(planes)):
        T = views.poses[middle[i]]
        R, t = split_pose(T)
        to_keyframe(R, t, planes[i], now)
        keyframes = _observers_at(views, T, observers[i])
        each = np.arange(len(keyframes.t)).astype(np.int32)
        then = np.empty((len(each), 4))
        to_observers(keyframes, each, planes[i], then)
        tangent_columns(now, B)
        N, X, seen = np.zeros((3, 3)), np.zeros((3, CALIBRATION)), 0
        for j in range(samples.shape[1]):
            point = samples[i, j].astype(np.float64)
            to_camera(R, t, point, p)
            distance_jacobian(now, p, J)
            if not placed_distance_error(point, J, each, keyframes, then, camera, width, height, views.scales, q, E, error):
                continue
            seen += 1
            row[0], row[1] = B[0, 0] * p[0] + B[1, 0] * p[1] + B[2, 0] * p[2], B[0, 1] * p[0] + B[1, 1] * p[1] + B[2, 1] * p[2]
            for a in range(3):
                for b in range(3):
                    N[a, b] += row[a] * row[b]
                for c in range(CALIBRATION):
                    X[a, c] += row[a] * error[c]
        if seen < LEAST_SAMPLES:
            turns[i] = views.sensitivities[middle[i], 3:]
            continue
        fitted = matmul(inverse_positive(N), X)  # points move along the normal, which turns by -B times the first two
        _fill_turn(now, -matmul(B, fitted[:2].copy()), turns[i])
    return turns


@kernel
def line_turns(ends: F64, observers: I32, middle: I32, views: Views) -> F64:
    """Return the rotation vectors (l, 3, 12) by which errors of the calibration turn lines through `ends` (l, 2, 3) of the world, each in the frame
    of its `middle` observer (l,), about axes across the line.

    Each of the observers (l, o), numbers of keyframes or -1, placed the part that it had in its image, by pixels and depth; they count by the
    information that this gives of the direction. The surfaces beside the line are not known, and their slope is left out. A line of which no
    observer had two samples in its image turns as its middle observer does."""
    turns, p, q = np.zeros((len(ends), 3, CALIBRATION)), np.empty((2, 3)), np.empty((2, 3))
    E, moved, at, camera = np.empty((3, CALIBRATION)), np.empty((3, CALIBRATION)), np.empty(3), views.camera
    surface = np.full(4, np.nan)
    for i in range(len(ends)):
        T = views.poses[middle[i]]
        R, t = split_pose(T)
        keyframes, total = _observers_at(views, T, observers[i]), 0.0
        direction = ends[i, 1] - ends[i, 0]
        length = np.sqrt(dot(direction, direction))
        moved[:] = 0.0  # points of the line, per metre along it
        for k in range(len(keyframes.t)):
            first, last = -1, -1
            for sample in range(LINE_SAMPLES):
                to_camera(keyframes.R[k], keyframes.t[k], ends[i, 0] + sample / (LINE_SAMPLES - 1.0) * direction, at)
                if in_view(at, camera, views.width, views.height):
                    first, last = sample if first < 0 else first, sample
            if not last > first:
                continue
            Q, share = matmul(R.T.copy(), keyframes.R[k]), (last - first) / (LINE_SAMPLES - 1.0)
            for end in range(2):
                world = ends[i, 0] + (last if end else first) / (LINE_SAMPLES - 1.0) * direction
                to_camera(R, t, world, p[end])
                to_camera(keyframes.R[k], keyframes.t[k], world, q[end])
            weight = (share * length / sigma_z(0.5 * (q[0, 2] + q[1, 2]), views.noise)) ** 2
            total += weight
            for end in range(2):
                signed = (weight if end else -weight) / (share * length)
                add_placed_error(
                    q[end], surface, p[end], Q, keyframes.errors[k], keyframes.twists[k], camera, views.width, views.height, views.scales, signed, E,
                    moved,
                )  # fmt: skip
        if total == 0.0:
            turns[i] = views.sensitivities[middle[i], 3:]
        else:
            _fill_turn(matvec(R.T.copy(), direction / length), moved / total, turns[i])
    return turns
