"""Relative poses by Open3D as the topic `pose`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.linalg import inv, matmul
from trihedron.pipeline.core.types import DEGRADED, F64, OK, Frame, Pose
from trihedron.plugins.pose.dense_alignment import CORRELATED, Alignment
from trihedron.plugins.pose.dense_pose import dense_pose

LEAST_SIGMA_M = 0.001  # of a point, however well the clouds agree


def relative_pose(frame: Frame, previous: Pose, T_previous_frame: F64, information: F64, share: float, rmse: float, least_share: float) -> Pose:
    """The pose of a frame aligned with the previous one by T (4, 4); lost below `least_share`.

    `information` (6, 6) is Open3D's, in its order (rotation, translation), for points of variance 1 m²; neighbouring points have correlated errors,
    so that many count as one. That understates the error (the poses drift by systematic errors of depth), and Open3D does not report directions that
    nothing observes: the pose is `degraded` at best, for `ok` would promise its covariance."""
    order = np.array([3, 4, 5, 0, 1, 2])
    variance = CORRELATED * max(rmse, LEAST_SIGMA_M) ** 2
    covariance = inv(information[np.ix_(order, order)] / variance + np.eye(6))
    pixels = int(information[3, 3])
    found = Alignment(T_previous_frame[:3, :3], T_previous_frame[:3, 3], covariance, np.empty((0, 3)), pixels, share)
    pose = dense_pose(frame, previous, matmul(previous.T_world_camera, T_previous_frame), found, least_share, "of the previous frame's points")
    return replace(pose, status=DEGRADED) if pose.status == OK else pose
