"""Uncertainty of a pose by an imperfect calibration: what no scatter of residuals shows, since every measurement shares it.

The error of a pose by the calibration is linear in its parameters θ (`shared.calibration_error`): `B θ`, with B the pose's `sensitivity`. It is zero
for the first pose. A frame like its keyframes repeats their errors, so B grows with what the view changed since, and keyframes hand theirs on: an
error of calibration is the same in all of them, and grows with the way from the origin where a random walk grows with its root. The residuals tell
of θ by the pattern that it leaves in them. The covariance `B E[θθᵀ] Bᵀ` is added to that of the pose (a Schmidt–Kalman filter); no pose is corrected.

A landmark is taken to be where the keyframes that observed it saw it on average, weighted by the information that each has of it. Relations
of planes, and the depth of lines, tell nothing of θ here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.types import F64, I32, Camera, Map, Pose
from trihedron.plugins.pose.map_alignment import MapAlignment
from trihedron.plugins.shared.calibration_error import CALIBRATION_NAMES, calibration_scales
from trihedron.plugins.shared.calibration_error_kernels import (
    Keyframes,
    Observers,
    Surfaces,
    calibration_equations,
    calibration_moment,
    keyframes_at,
    moved_sensitivity,
    sensitivity_and_evidence,
)
from trihedron.plugins.shared.plane_offsets import samples_of
from trihedron.plugins.shared.plane_offsets_kernels import distance_sigmas
from trihedron.plugins.shared.pose_optimizer_kernels import Flags

REPEATED_FRAMES = 100  # in which the errors of a landmark's residuals repeat: so many frames tell of the calibration as much as one
NOTICED_FRAMES = 20  # the same where the stated calibration is judged: with more, its prior hides a large error for a second
CALIBRATION_SIGMAS = 2.0  # root mean square of the parameters beyond which the calibration is not that of the camera


def reference_velocity(pose: Pose, previous: Pose, map: Map) -> F64:
    """Return the velocity (6,) of a pose's reference keyframe: the mean of the motions to it and from it; zero without one."""
    if not 0 <= pose.reference < len(map.keyframes):
        return np.zeros(6)
    if int(map.keyframes.row("index", pose.reference)) == previous.index:
        known = pose.twist.any() and previous.twist.any()
        return 0.5 * (previous.twist + pose.twist) if known else pose.twist
    return previous.reference_twist if previous.reference == pose.reference else np.asarray(map.keyframes.row("twist", pose.reference))


def with_calibration(pose: Pose, previous: Pose, problem: MapAlignment, flags: Flags, keyframes: Keyframes, observed: Observers) -> Pose:
    """Give a refined pose its sensitivity to the calibration, and what its residuals add to what is known of that."""
    T, camera = constant(pose.T_world_camera, np.float64), problem.camera
    points, lines, planes = problem.terms(pose.T_world_camera)
    samples = problem.map.planes.rows("samples_m", problem.matches.planes[:, 1])
    at_ends = problem.surfaces_at(lines.endpoints_px.reshape(-1, 2)).reshape(-1, 2, 4)
    surfaces = Surfaces(problem.surfaces_at(problem.keypoints.pixels[problem.matches.keypoints[:, 0]]), at_ends)
    equations = calibration_equations(
        T, camera.intrinsics, camera.width, camera.height, calibration_scales(camera), pose.twist, points, lines, planes, flags, surfaces, samples,
        observed, keyframes,
    )  # fmt: skip
    before = carried_sensitivity(pose, previous)
    sensitivity, information, score = sensitivity_and_evidence(equations, problem.information, before)
    scale = REPEATED_FRAMES * pose.noise_scale
    return replace(
        pose,
        sensitivity=sensitivity,
        calibration_information=previous.calibration_information + information / scale,
        calibration_score=previous.calibration_score + score / scale,
        depth_scale_sigma=camera.sigmas.depth_scale,
    )


def plane_sigmas_m(pose: Pose, problem: MapAlignment) -> F64:
    """Return the standard deviations (m, s), by the calibration, of the distances (m) of the samples of matched planes (`samples_of`) from the map's;
    NaN for samples that no keyframe which observed the plane had in its image."""
    planes, map, camera = problem.matches.planes, problem.map, problem.camera
    rows, _, observed = problem.keyframes
    return distance_sigmas(
        constant(pose.T_world_camera, np.float64), camera.intrinsics, camera.width, camera.height, calibration_scales(camera), pose.twist,
        pose.sensitivity, calibration_moment(pose.calibration_information, pose.calibration_score),
        map.planes.rows("coefficients", planes[:, 1]), constant(samples_of(problem.planes, planes), np.float32), observed.planes,
        keyframes_seen(pose, map, camera, rows, map.keyframes.rows("T_world_camera", rows)),
    )  # fmt: skip


def keyframes_seen(pose: Pose, map: Map, camera: Camera, rows: I32, poses: F64) -> Keyframes:
    """Return the keyframes in rows (k,) of the map, with poses (k, 4, 4), their velocities, and their errors by the calibration for the camera."""
    sensitivities, twists = map.keyframes.columns_at(rows, "sensitivity", "twist")
    twists[rows == pose.reference] = pose.reference_twist
    return keyframes_at(
        constant(pose.T_world_camera, np.float64), poses, constant(twists, np.float64), sensitivities, camera.depth_noise.coefficients
    )


def carried_sensitivity(pose: Pose, previous: Pose) -> F64:
    """Return the previous pose's sensitivity as that of a camera that moves with it."""
    T, before = (constant(T, np.float64) for T in (pose.T_world_camera, previous.T_world_camera))
    return moved_sensitivity(T, before, previous.sensitivity)


def contradicted_calibration(pose: Pose) -> str:
    """Return why the residuals so far contradict the stated calibration; empty where they do not.

    The parameters are independent and have standard deviations of 1 in the units of `calibration_scales`; their root mean square so far is at most
    1.3 in sequences of five cameras and six simulated ones, 23 with a focal length off by a fifth."""
    as_noticed = REPEATED_FRAMES / NOTICED_FRAMES
    size = np.sqrt(np.diag(calibration_moment(as_noticed * pose.calibration_information, as_noticed * pose.calibration_score)))
    if np.sqrt((size * size).mean()) <= CALIBRATION_SIGMAS:
        return ""
    worst = int(np.argmax(size))
    return f"the images contradict the camera's calibration: {CALIBRATION_NAMES[worst]} is off by {size[worst]:.0f} times what is usual"


def carried_calibration(pose: Pose, previous: Pose) -> Pose:
    """Give a pose that was not refined the previous one's error by the calibration, as a camera that moves with it."""
    return replace(
        pose,
        sensitivity=carried_sensitivity(pose, previous),
        calibration_information=previous.calibration_information,
        calibration_score=previous.calibration_score,
        depth_scale_sigma=previous.depth_scale_sigma,
    )
