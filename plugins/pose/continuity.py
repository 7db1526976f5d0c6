"""Continuity of the camera's motion: whether it can have moved from the previous pose to this one.

The motion of a camera that is carried changes little from one frame to the next: velocities differ by its acceleration. An image of another place or
time, which a driver delivers late, say, agrees with the map of that place and contradicts nothing but the motion. How much acceleration is usual a
run shows by itself, since poses tremble and time stamps may be nominal. A change far beyond that, and beyond what a camera is ever carried with, is a
jump: what comes after it is ok once several frames in a row have confirmed it (`judgement.py`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import log_se3
from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.types import DEGRADED, F64, LOST, OK, Pose

CARRIED = np.array([50.0, 150.0])  # m/s² and rad/s²: at most 37 and 46 in 81 clean runs of six sequences and five simulated sensors
UNUSUAL = 3.0  # times the largest accelerations of late
FORGOTTEN = 0.01  # of the largest of late, in each frame
LEARNED = 0.01  # of a jump: what goes on for long becomes usual
LEAST_FRAMES = 10  # that show what is usual
SIGMAS = 4.0  # standard deviations of both poses that are no acceleration
THERE_AND_BACK = 2  # jumps in a row after which the velocity is still that before: one image of another place. A third is how the camera moves now
LONGEST_S = 1.0  # between two frames that a velocity is taken from
UNITS = "m/s²", "rad/s²"


def with_motion(pose: Pose, previous: Pose) -> Pose:
    """Give a pose (with `covariance` relative to the landmarks near it) its motion since the previous one: velocity, `jumps` and
    `usual_accelerations`. An ok pose that is a jump is degraded."""
    if pose.repeats:
        return replace(pose, twist=previous.twist, usual_accelerations=previous.usual_accelerations)
    twist = _velocity(pose, previous)
    accelerations = _accelerations(twist, pose, previous)
    if accelerations is None:
        return replace(pose, twist=twist, usual_accelerations=previous.usual_accelerations)
    reason = _jump(accelerations, previous)
    pose = replace(pose, twist=twist, usual_accelerations=_usual(accelerations, previous, bool(reason)))
    return _jumped(pose, previous, reason) if reason else pose


def _jumped(pose: Pose, previous: Pose, reason: str) -> Pose:
    """Count a jump in a pose, which is not ok then. The first ones in a row leave the velocity as it was."""
    jumps = previous.jumps + 1
    pose = replace(pose, jumps=jumps, twist=previous.twist if jumps <= THERE_AND_BACK else pose.twist)
    return replace(pose, status=DEGRADED, reason=reason) if pose.status == OK else pose


def _velocity(pose: Pose, previous: Pose) -> F64:
    """Return the velocity (6,) in the camera's frame since the previous pose, or since the image that the previous one repeats; zero where that is
    not known."""
    seconds = _seconds(pose, previous) * (1 + previous.repeats)
    if previous.status == LOST or not 0.0 < seconds <= LONGEST_S:
        return np.zeros(6)
    return np.asarray(log_se3(matmul(invert(previous.T_world_camera), pose.T_world_camera)) / seconds)


def _accelerations(twist: F64, pose: Pose, previous: Pose) -> F64 | None:
    """Return the linear and angular acceleration (2,), beyond the noise of both poses, from the previous velocity to `twist`; None where one of these
    is not known."""
    if previous.repeats or pose.submap != previous.submap or not (twist.any() and previous.twist.any()):
        return None
    seconds = _seconds(pose, previous)
    variances = np.diagonal(pose.local_covariance + previous.local_covariance).reshape(2, 3).sum(axis=1).clip(0.0)  # below 0 by rounding
    changes = np.array([norm(part) for part in (twist - previous.twist).reshape(2, 3)])
    return np.asarray(np.maximum(changes / seconds - SIGMAS * np.sqrt(variances) / seconds**2, 0.0))


def _jump(accelerations: F64, previous: Pose) -> str:
    """Return why accelerations (2,) are those of a jump, empty where they are not: one is far beyond that of a camera that is carried, and beyond
    those usual in this run."""
    frames, *usual = previous.usual_accelerations.tolist()
    far = accelerations / np.maximum(CARRIED, UNUSUAL * np.array(usual))
    worst = int(np.argmax(far))
    if frames < LEAST_FRAMES or far[worst] <= 1.0:
        return ""
    return f"a jump: the motion since the previous frame takes {accelerations[worst]:.0f} {UNITS[worst]}, usually at most {usual[worst]:.0f}"


def _usual(accelerations: F64, previous: Pose, jumped: bool) -> F64:
    """Return `Pose.usual_accelerations` with those of a frame."""
    frames, usual = previous.usual_accelerations[0], previous.usual_accelerations[1:]
    learned = usual + LEARNED * (accelerations - usual) if jumped else accelerations
    return np.array([min(frames + 1.0, LEAST_FRAMES), *np.maximum((1.0 - FORGOTTEN) * usual, learned)])


def _seconds(pose: Pose, previous: Pose) -> float:
    return 1e-9 * (pose.stamp_ns - previous.stamp_ns)
