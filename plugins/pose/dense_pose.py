"""The pose, with status and reason, of a dense alignment: without features and without a map of them."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, nearest_rotation, pose_matrix
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import DEGRADED, F64, LOST, OK, Frame, Pose
from trihedron.plugins.pose.decoupled_pose import FIRST_SIGMA, Decoupled
from trihedron.plugins.pose.dense_alignment import Alignment

NONE = np.zeros(3, np.int32)
LOST_SIGMA = 1.0  # m and rad, of a lost pose


def first_pose(frame: Frame) -> Pose:
    """The identity."""
    return Decoupled(np.eye(4), FIRST_SIGMA**2 * np.eye(6), NONE, 0, OK, "first frame, origin of the world").to_pose(frame, None)


def dense_pose(frame: Frame, previous: Pose, T: F64, found: Alignment, min_share: float, of_what: str, ends_loss: bool = False) -> Pose:
    """The aligned pose T (4, 4) with status and reason; lost, and held at the previous pose, where less than `min_share` of the points agree.

    A lost camera is relocalised only with `ends_loss`, and when all directions are observed."""
    T = pose_matrix(nearest_rotation(T[:3, :3]), T[:3, 3])  # rounding grows from frame to frame
    held, lost = len(found.unobservable), previous.status == LOST
    agreement = f"{found.share:.0%} {of_what} agree"
    if lost and not ends_loss:
        return lost_pose(frame, previous, "the motion since the pose was lost is not known")
    if found.share < min_share or held == 3 or (lost and held):
        return lost_pose(frame, previous, f"only {agreement}" if found.share < min_share else "no direction of motion is observable")
    inverse = matmul(
        invert(T)[:3, :3], previous.T_world_camera[:3, :3]
    )  # xi of the target's frame in this camera's: the motion between them is small
    rotate = np.kron(np.eye(2), inverse)
    covariance = matmul(rotate, found.covariance, rotate.T)
    if not ends_loss:
        covariance = covariance + matmul(rotate, previous.covariance, rotate.T)
    counted = np.array([found.pixels, 0, 0], np.int32)
    status, reason = (DEGRADED, f"{held} directions of motion are unobservable, held at the prediction") if held else (OK, agreement)
    return Decoupled(T, covariance, counted, held, status, reason).to_pose(frame, None)


def lost_pose(frame: Frame, previous: Pose, reason: str) -> Pose:
    """The previous pose, lost."""
    return Decoupled(previous.T_world_camera, LOST_SIGMA**2 * np.eye(6), NONE, 3, LOST, reason).to_pose(frame, None)
