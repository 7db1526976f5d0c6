"""Contradiction between depth and colour: planes, which depth alone measures, turn from frame to frame as the camera does by its points and lines.

Where colour is frozen, partly or with noise, or mirrored, points and lines agree with each other on a motion that is not that of the depth images. In
one frame the difference is within the noise of the planes; as it does not change, its mean over ten frames is not.

Where depth lags colour, planes turn as the camera did a little earlier: beyond its own turn by the lag times the change of its angular velocity. The
stated standard deviation of the lag counts beside what is usual of the mean."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import LOST, CalibrationSigmas, Camera, Planes, Pose, Tracks
from trihedron.plugins.shared.plane_turns_kernels import rotation_of_normals

TURN_FRAMES, USUAL_FRAMES = 10, 30  # that the difference, and its usual size in a frame, are averaged over
LARGEST = 2.0  # times the usual size that a frame counts at most
NORMAL_DEG = 0.2  # added to a plane's own standard deviation: depth has errors that its noise does not show
PRIOR_DEG = 1.0  # standard deviation of the difference in a frame, before it is measured
MOST_SIGMAS = 4.0  # of the mean; at most 3.6 of 75 simulated sensors and five sequences, but for one frame of hololens_walk
LEAST_DEG = 1.0  # over ten frames, that is worth a doubt: less is a bias of depth
TINY = 1e-9


def with_turn_difference(pose: Pose, previous: Pose, tracks: Tracks | None, planes: Planes, camera: Camera) -> Pose:
    """Give a refined pose, whose velocity is known, the moving averages of the rotation that planes show beyond its own, since the previous one, and
    of what a lag of depth would show of that; those of the previous one where it is not measured."""
    mean, usual, by_lag = previous.turn_difference, previous.usual_turn_difference, previous.turn_by_lag
    comparable = previous.status != LOST and pose.submap == previous.submap
    if comparable and tracks is not None and tracks.previous_index == previous.index and len(tracks.planes) > 1:
        now = tracks.planes[:, 1]
        covariances = tracks.plane_covariance + planes.covariance[now]
        variance = covariances[:, 0, 0] + covariances[:, 1, 1] + math.radians(NORMAL_DEG) ** 2
        R = np.ascontiguousarray(matmul(invert(previous.T_world_camera), pose.T_world_camera)[:3, :3])
        before, normals = (np.ascontiguousarray(coefficients[:, :3]) for coefficients in (tracks.coefficients, planes.coefficients[now]))
        importance = np.sqrt(planes.pixels[now] / planes.pixels[now].mean())  # what moves is seldom large
        difference = rotation_of_normals(before, normals, variance, importance, R, math.radians(PRIOR_DEG))
        mean = mean + (difference - mean) / TURN_FRAMES
        by_lag = by_lag + (_lag_s(camera.sigmas) * (pose.twist[3:] - previous.twist[3:]) - by_lag) / TURN_FRAMES
        usual += (min(math.hypot(*difference.tolist()), LARGEST * usual) - usual) / USUAL_FRAMES
    return replace(pose, turn_difference=mean, usual_turn_difference=usual, turn_by_lag=by_lag)


def _lag_s(sigmas: CalibrationSigmas) -> float:
    """Return the standard deviation, in s, of the time by which a row of depth lags the same row of colour: a rolling shutter reads it by up to half
    of the readout before or after the middle one."""
    return math.hypot(sigmas.delay_s, 0.5 * sigmas.readout_s, 0.5 * sigmas.depth_readout_s)


def contradicting_turn(pose: Pose) -> str:
    """Return why depth and colour contradict each other in how the camera turned of late; empty where they do not."""
    mean = math.hypot(*pose.turn_difference.tolist())
    usual = pose.usual_turn_difference / math.sqrt(2 * TURN_FRAMES - 1)  # of a moving average of independent values
    sigmas = mean / max(math.hypot(usual, *pose.turn_by_lag.tolist()), TINY)
    turned_deg = math.degrees(mean * TURN_FRAMES)
    if sigmas <= MOST_SIGMAS or turned_deg <= LEAST_DEG:
        return ""
    return f"colour and depth contradict each other: in {TURN_FRAMES} frames the planes turned by {turned_deg:.1f}° more than points and lines"
