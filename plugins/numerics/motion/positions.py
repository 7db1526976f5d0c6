"""What every estimator of the position with the rotation fixed says alike: the first frame's, and one that was not measured."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, LOST, Frame, Pose, Translation


def origin(frame: Frame) -> Translation:
    """The first frame's position, the origin of the world, which is certain."""
    return Translation(frame.index, frame.stamp_ns, np.zeros(3), np.zeros((3, 3)), np.empty((0, 3)), np.zeros(3, np.int32), True)


def unmeasured(frame: Frame, t_world_camera: F64, covariance: F64) -> Translation:
    """A position (3,) that is only predicted, with its covariance (3, 3)."""
    return Translation(frame.index, frame.stamp_ns, t_world_camera, covariance, np.eye(3), np.zeros(3, np.int32), False)


def handed_on(previous: Pose, held_too: bool = False) -> F64:
    """(3, 3) covariance (world) that a pose which was lost, or with `held_too` held in some direction, hands on to what is put on top of it; others
    hand on none: the world is where they say."""
    R, known = previous.T_world_camera[:3, :3], previous.status != LOST and not (held_too and previous.unobservable)
    return np.zeros((3, 3)) if known else np.asarray(R @ previous.covariance[:3, :3] @ R.T)
