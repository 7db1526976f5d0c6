"""Positions that are not measured: the first frame's, predicted ones, and the covariance propagated from the previous pose."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, LOST, Pose, Rotation, Translation


def origin(rotation: Rotation) -> Translation:
    """The first frame's position, the origin of the world, which is exact."""
    return Translation(rotation.index, rotation.stamp_ns, np.zeros(3), np.zeros((3, 3)), np.empty((0, 3)), np.zeros(3, np.int32), True)


def predicted_translation(rotation: Rotation, t_world_camera: F64, covariance: F64) -> Translation:
    """A predicted position (3,) with its covariance (3, 3)."""
    return Translation(rotation.index, rotation.stamp_ns, t_world_camera, covariance, np.eye(3), np.zeros(3, np.int32), False)


def propagated_covariance(previous: Pose, held_too: bool = False) -> F64:
    """Covariance (3, 3) (world) that a previous pose propagates to the next: its own if it was lost, or with `held_too` unobservable in some
    direction; else zero, since the world is defined by tracked poses."""
    R, known = previous.T_world_camera[:3, :3], previous.status != LOST and not (held_too and previous.unobservable)
    return np.zeros((3, 3)) if known else np.asarray(matmul(R, previous.local_covariance[:3, :3], R.T))
