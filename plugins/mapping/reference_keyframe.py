"""Poses relative to their reference keyframes, and the decoupled pose.

A correction of the map is applied at the end of a frame, after its pose was estimated. The pose is stored relative to its reference keyframe, so
that poses, and the world–Manhattan rotations estimated with them, follow a corrected keyframe without a jump.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.types import DEGRADED, F64, I32, LOST, OK, Map, Pose, Rotation, Translation, Value
from trihedron.plugins.mapping.covisibility_graph import keyframes_of

UNMOVED = 1e-12  # rad and m: rounding; a keyframe that moved by less leaves the pose unchanged


def transform_to_map(pose: Pose, map: Map | None) -> Pose:
    """Re-express a pose through its reference keyframe's newest `T_world_camera`; the same object when that has not moved, or there is none."""
    if map is None or not 0 <= pose.reference < len(map.keyframes):
        return pose
    T_world_keyframe = map.keyframes.row("T_world_camera", pose.reference)
    relative = invert(T_world_keyframe) @ pose.T_world_camera
    if np.abs(relative - pose.T_reference_camera).max() < UNMOVED:
        return pose
    return replace(pose, T_world_camera=T_world_keyframe @ pose.T_reference_camera)


def transform_rotation_to_map(previous: Rotation, pose: Pose | None, map: Map | None) -> tuple[Rotation, Pose | None]:
    """Rotate the previous rotation and pose with the pose's reference keyframe, by `R_new · R_oldᵀ` from the left: the camera and the Manhattan
    frames keep their angles to the landmarks near them."""
    if pose is None:
        return previous, None
    now = transform_to_map(pose, map)
    if now is pose:
        return previous, pose
    rotate = now.T_world_camera[:3, :3] @ pose.T_world_camera[:3, :3].T
    return replace(previous, R_world_camera=rotate @ previous.R_world_camera, R_world_manhattan=rotate @ previous.R_world_manhattan), now


def submap_of(pose: Pose, map: Map | None) -> int:
    """The sub-map a pose is in: that of its reference keyframe in the newest map."""
    if map is None or not 0 <= pose.reference < len(map.keyframes):
        return pose.submap
    return int(map.keyframes.row("submap", pose.reference))


# The decoupled pose of rotation and translation, before any refinement.

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
        return Pose(
            frame.index,
            frame.stamp_ns,
            self.T_world_camera,
            self.covariance,
            T_reference_camera,
            reference,
            self.inliers,
            self.unobservable,
            status,
            self.reason if status == LOST or not reason else reason,
            submap,
        )


def decoupled_pose(rotation: Rotation, translation: Translation, previous: Pose | None, relocalise: Pose | None = None) -> Decoupled:
    """The decoupled pose with its status. Lost when nothing of this frame took part, and on top of a lost pose, however well the frames fit each
    other: relative motion alone cannot localise. A relocalised frame starts from there."""
    if relocalise is not None and relocalise.status == OK:
        return Decoupled(relocalise.T_world_camera, relocalise.covariance, relocalise.inliers, relocalise.unobservable, OK, relocalise.reason)
    T = pose_matrix(rotation.R_world_camera, translation.t_world_camera)
    covariance = np.zeros((6, 6))
    R = rotation.R_world_camera
    covariance[:3, :3] = R.T @ translation.covariance @ R + FIRST_SIGMA**2 * np.eye(3)
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


def reference_of(map: Map | None, T_world_camera: F64, submap: int = 0) -> tuple[int, F64]:
    """The newest living keyframe of the sub-map and the pose relative to it; (-1, T_world_camera) without one."""
    newest = keyframes_of(map, submap)[-1:] if map is not None else np.empty(0, np.int32)
    if map is None or len(newest) == 0:
        return -1, T_world_camera
    return int(newest[0]), invert(map.keyframes.row("T_world_camera", int(newest[0]))) @ T_world_camera
