"""Uncertainty of a refined pose in the world: the noise that its residuals show, and the uncertainty of the keyframes that its landmarks are from.

A pose is estimated relative to hundreds of landmarks whose errors are treated as independent. Two parts are not: residuals of landmarks from one
keyframe err alike, which their scatter shows (`noise_scale`); and the common error of the keyframes themselves, which no residual shows
(`map_covariance`). The latter accumulates from keyframe to keyframe: at random, which odometry calls drift, and by an imperfect calibration, which
is the same at all of them (`calibration_uncertainty.py`). An image that repeats the one before measures nothing: the camera may have moved since."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.lie import adjoint_between
from trihedron.pipeline.core.linalg import eigvalsh, matmul
from trihedron.pipeline.core.types import F64, I32, Map, Pose
from trihedron.plugins.mapping.reference_keyframe import with_relative_sensitivity
from trihedron.plugins.pose.calibration_uncertainty import carried_calibration, keyframes_seen, reference_velocity, with_calibration
from trihedron.plugins.pose.map_alignment import MapAlignment
from trihedron.plugins.pose.world_uncertainty_kernels import scatter_and_drift
from trihedron.plugins.shared.calibration_error import calibration_covariance
from trihedron.plugins.shared.calibration_error_kernels import Observers
from trihedron.plugins.shared.pose_optimizer import LANDMARK_SCORE, PoseSolution
from trihedron.plugins.shared.pose_optimizer_kernels import OUTLIER, Flags

SCALE_FRAMES = 10  # over which the scale of the residuals is averaged
SCALE_OUTLIER = 4.0  # times the average that a frame's scale counts at most
LATE_KEYFRAMES = 10  # before the reference keyframe, of late: what none of them observed has long been out of view
UNSEEN_SPEED = 0.2  # m/s and rad/s of a hand-held camera, root mean square: 0.17 to 0.20 and 0.12 to 0.20 (three sequences)


@dataclass(frozen=True)
class KeyframeUncertainty:
    """The keyframe (row, -1: none) that a pose is relative to, and the standard deviation of its position (m) in the worst direction."""

    keyframe: int
    sigma_m: float

    def covariance(self, map: Map, T_world_camera: F64) -> F64:
        """Covariance (6, 6) of the keyframe as that of xi of a camera that moves with it."""
        T, covariance = (map.keyframes.rows(name, np.array([self.keyframe]))[0] for name in ("T_world_camera", "covariance"))
        to_camera = adjoint_between(T_world_camera, T)
        return np.asarray(matmul(to_camera, covariance, to_camera.T))


def keyframe_uncertainty(map: Map, points: I32, lines: I32, planes: I32) -> KeyframeUncertainty:
    """Select the weighted median, by σ, of the keyframes that created these landmarks (ids).

    A landmark's covariance includes its first keyframe's, but a pose estimated from hundreds of them averages out what is common to all."""
    weights = np.zeros(len(map.keyframes), np.int64)
    for table, ids, score in zip((map.points, map.lines, map.planes), (points, lines, planes), LANDMARK_SCORE):
        weights += score * np.bincount(table.rows("first", ids), minlength=len(weights))
    keyframes = np.flatnonzero(weights)
    if not len(keyframes):
        return KeyframeUncertainty(-1, 0.0)
    sigmas_m, half = _sigmas_m(map, keyframes.tolist()), int(weights.sum()) // 2
    below = 0
    for keyframe in sorted(keyframes.tolist(), key=sigmas_m.__getitem__):
        below += int(weights[keyframe])
        if below > half:
            break
    return KeyframeUncertainty(keyframe, sigmas_m[keyframe])


def _sigmas_m(map: Map, keyframes: list[int]) -> dict[int, float]:
    """Standard deviations of (at least) these keyframes' positions in their worst directions; computed once per version of the map."""
    sigmas_m: dict[int, float] = map.memo.setdefault("sigmas_m", {})
    if new := [keyframe for keyframe in keyframes if keyframe not in sigmas_m]:
        covariances = map.keyframes.rows("covariance", np.array(new))
        sigmas_m.update(zip(new, np.sqrt(eigvalsh(covariances[:, :3, :3])[:, -1]).tolist()))
    return sigmas_m


def keyframe_covariance(solution: PoseSolution, problem: MapAlignment, factor: float) -> F64:
    """Covariance (6, 6) of the keyframes as that of a pose, where they are uncertain by more than `factor` times its own standard deviation:
    landmarks made from this pose would average it away. Zero elsewhere."""
    base = keyframe_uncertainty(problem.map, *problem.landmarks(solution))
    if base.sigma_m <= factor * np.sqrt(eigvalsh(solution.covariance[:3, :3])[-1]):
        return np.zeros((6, 6))
    return base.covariance(problem.map, solution.T_world_camera)


def in_world(pose: Pose, previous: Pose, solution: PoseSolution, problem: MapAlignment) -> Pose:
    """Give a refined pose with its motion its covariance in the world, scaled by the noise that the residuals show."""
    rows, created, observed = problem.keyframes
    poses, covariances = problem.map.keyframes.columns_at(rows, "T_world_camera", "world_covariance")
    T, flags = pose.T_world_camera, Flags(solution.points, solution.lines, solution.planes)
    flags = without_chance_agreement(flags, observed, rows, pose.reference)
    scale, by_drift, supported = scatter_and_drift(
        constant(T, np.float64), problem.camera.intrinsics, *problem.terms(T), flags, created, poses, covariances
    )
    if not supported:
        by_drift = drift_of_previous(pose, previous)
    noise_scale = previous.noise_scale
    if not math.isnan(scale):
        noise_scale += (min(scale, SCALE_OUTLIER * noise_scale) - noise_scale) / SCALE_FRAMES
    moving = replace(pose, noise_scale=noise_scale, reference_twist=reference_velocity(pose, previous, problem.map))
    if pose.repeats or pose.jumps:
        moving = carried_calibration(moving, previous)
    else:
        moving = with_calibration(moving, previous, problem, flags, keyframes_seen(moving, problem.map, problem.camera, rows, poses), observed)
    in_world = _with_world_covariance(with_relative_sensitivity(moving, problem.map), by_drift)
    return _with_unseen_motion(in_world, previous) if pose.repeats else in_world


def without_chance_agreement(flags: Flags, observed: Observers, rows: I32, reference: int) -> Flags:
    """Return the flags of the matches that show where the camera is in the world: without inliers among landmarks that no keyframe has observed of
    late, if most matches with such landmarks are outliers.

    Args:
        flags: those of points, lines and planes, of which the identical ones are first.
        observed: numbers of the keyframes that observed them.
        rows: (k,) rows of these keyframes in the map, increasing.
        reference: row of the reference keyframe.

    Where a camera that has drifted comes back, it matches edges with others that look the same, and a few agree by chance. Each would count as if the
    camera erred as it did when that place was mapped, although the pose, which hundreds of new landmarks determine, does not return by it."""
    earlier = [rows[seen.max(axis=1)] < reference - LATE_KEYFRAMES for seen in observed]
    of_earlier = [kind[: len(seen)][seen] for kind, seen in zip(flags, earlier)]
    if 2 * sum(np.count_nonzero(agree) for agree in of_earlier) >= sum(map(len, of_earlier)):
        return flags
    kept = Flags(*(kind.copy() for kind in flags))
    for kind, seen in zip(kept, earlier):
        kind[: len(seen)][seen] = OUTLIER
    return kept


def _with_unseen_motion(pose: Pose, previous: Pose) -> Pose:
    """Add to the covariance of a pose whose image repeats an earlier one how far the camera may have moved since that was taken: on at the velocity
    that it had (`twist`), together with that of a hand-held camera, in any direction."""
    seconds = 1e-9 * pose.repeats * (pose.stamp_ns - previous.stamp_ns)
    squared = (pose.twist.reshape(2, 3) ** 2).sum(axis=1) + UNSEEN_SPEED**2
    return replace(pose, covariance=pose.covariance + np.diag(np.repeat(seconds**2 / 3.0 * squared, 3)))


def _with_world_covariance(pose: Pose, by_drift: F64) -> Pose:
    """Turn a pose whose `covariance` is the one relative to the landmarks near it into one whose `covariance` is that in the world."""
    of_map = by_drift + calibration_covariance(pose)
    return replace(pose, covariance=pose.noise_scale * pose.covariance + of_map, map_covariance=of_map)


def drift_of_previous(pose: Pose, previous: Pose) -> F64:
    """The part of the previous pose's `map_covariance` that is not by the calibration, as that of a camera that moves with it."""
    to_camera = adjoint_between(pose.T_world_camera, previous.T_world_camera)
    return np.asarray(matmul(to_camera, previous.map_covariance - calibration_covariance(previous), to_camera.T))


def propagate_world_covariance(pose: Pose, previous: Pose) -> Pose:
    """Give a pose that was not refined, by its own covariance relative to the previous one, its covariance in the world."""
    return _with_world_covariance(carried_calibration(replace(pose, noise_scale=previous.noise_scale), previous), drift_of_previous(pose, previous))
