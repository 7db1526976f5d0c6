"""The decoupled pose: rotation and translation as they were estimated, before any refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import DEGRADED, F64, I32, LOST, OK, Map, Pose, Rotation, Translation, Value
from trihedron.plugins.mapping.reference_keyframe import reference_of

FIRST_SIGMA = 1e-6  # the first pose is exact by definition; positive, so that covariances stay invertible


@dataclass(frozen=True)
class Decoupled:
    """`T_world_camera` (4, 4) with covariance (6, 6) of xi, counts of points, lines and planes, status and reason."""

    T_world_camera: F64
    covariance: F64
    inliers: I32
    unobservable: int
    status: str
    reason: str

    def to_pose(self, frame: Value, map: Map | None, reason: str = "", submap: int = 0) -> Pose:
        """Convert to the frame's pose in a sub-map; `reason` is why no refinement followed (degraded, unless lost already)."""
        status = DEGRADED if reason and self.status == OK else self.status
        reference, T_reference_camera = reference_of(map, self.T_world_camera, submap)
        reason = self.reason if status == LOST or not reason else reason
        relative = T_reference_camera, reference
        return Pose(
            frame.index, frame.stamp_ns, self.T_world_camera, self.covariance, *relative, self.inliers, self.unobservable, status, reason, submap
        )


def decoupled_pose(rotation: Rotation, translation: Translation, previous: Pose | None, relocalise: Pose | None = None) -> Decoupled:
    """Compose the decoupled pose and its status. Lost when nothing of this frame took part, and on top of a lost pose, however well the frames fit
    each other: relative motion alone cannot localise. A relocalised frame starts from there."""
    if relocalise is not None and relocalise.status == OK:
        return Decoupled(relocalise.T_world_camera, relocalise.covariance, relocalise.inliers, relocalise.unobservable, OK, relocalise.reason)
    T = pose_matrix(rotation.R_world_camera, translation.t_world_camera)
    covariance = np.zeros((6, 6))
    R = rotation.R_world_camera
    covariance[:3, :3] = matmul(R.T, translation.covariance, R) + FIRST_SIGMA**2 * np.eye(3)
    covariance[3:, 3:] = rotation.covariance + FIRST_SIGMA**2 * np.eye(3)
    unobservable = len(translation.unobservable)
    if previous is None:
        return Decoupled(T, FIRST_SIGMA**2 * np.eye(6), translation.inliers, 0, OK, "first frame, origin of the world")
    status, reason = _judge(rotation, translation, unobservable)
    if previous.status == LOST and status != LOST:
        status, reason = LOST, "relocalisation failed since the pose was lost"
    return Decoupled(T, covariance, translation.inliers, unobservable, status, reason)


def _judge(rotation: Rotation, translation: Translation, unobservable: int) -> tuple[str, str]:
    if not translation.estimated:
        return LOST, "no feature of the previous frame was matched"
    if unobservable:
        return DEGRADED, f"{unobservable} directions of motion are unobservable, held at the prediction"
    if rotation.source == "prediction":
        return DEGRADED, "the rotation was predicted, not measured"
    return OK, "{} points, {} lines and {} planes of the previous frame".format(*translation.inliers)
