"""Poses of systems that align images, without features and without a map of them."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import invert, nearest_rotation, pose_matrix
from trihedron.pipeline.core.types import DEGRADED, F64, LOST, OK, Frame, Pose
from trihedron.plugins.numerics.maps.decoupled import FIRST_SIGMA, Decoupled
from trihedron.plugins.numerics.motion.dense_alignment import Alignment

NONE = np.zeros(3, np.int32)
LOST_SIGMA = 1.0  # m and rad, that a lost pose is uncertain by


def first_pose(frame: Frame) -> Pose:
    """The identity."""
    return Decoupled(np.eye(4), FIRST_SIGMA**2 * np.eye(6), NONE, 0, OK, "first frame, origin of the world").said(frame, None)


def dense_pose(frame: Frame, previous: Pose, T: F64, found: Alignment, min_share: float, of_what: str, ends_loss: bool = False) -> Pose:
    """The aligned pose T (4, 4) with status and reason; where less than `min_share` agrees it is lost, and stays at the previous one. A lost camera
    is found again only where that is said to be possible (`ends_loss`), and all directions are measured."""
    T = pose_matrix(nearest_rotation(T[:3, :3]), T[:3, 3])  # rounding grows from frame to frame
    held, lost = len(found.unobservable), previous.status == LOST
    said = f"{found.share:.0%} {of_what} agree"
    if lost and not ends_loss:
        return _lost(frame, previous, "the motion since the pose was lost is not known")
    if found.share < min_share or held == 3 or (lost and held):
        return _lost(frame, previous, f"only {said}" if found.share < min_share else "no direction of motion can be seen")
    inverse = invert(T)[:3, :3] @ previous.T_world_camera[:3, :3]  # xi of the target's frame in this camera's: the motion between them is small
    turn = np.kron(np.eye(2), inverse)
    covariance = turn @ found.covariance @ turn.T
    if not ends_loss:
        covariance = covariance + turn @ previous.covariance @ turn.T
    counted = np.array([found.pixels, 0, 0], np.int32)
    status, reason = (DEGRADED, f"{held} directions of motion cannot be seen, held at the prediction") if held else (OK, said)
    return Decoupled(T, covariance, counted, held, status, reason).said(frame, None)


def _lost(frame: Frame, previous: Pose, reason: str) -> Pose:
    return Decoupled(previous.T_world_camera, LOST_SIGMA**2 * np.eye(6), NONE, 3, LOST, reason).said(frame, None)
