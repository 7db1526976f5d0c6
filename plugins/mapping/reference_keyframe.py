"""What was said before a correction of the map, as it stands in the map now.

A correction is applied at the end of a frame, after its pose was said. The pose names its reference keyframe and its place relative to it, and the
map's newest version says where that keyframe is: poses, and the world–Manhattan rotations tied to them, follow it without a jump.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.types import DEGRADED, F64, I32, LOST, OK, Map, Pose, Rotation, Translation, Value
from trihedron.plugins.mapping.covisibility_graph import keyframes_of

UNMOVED = 1e-12  # rad and m: rounding; a keyframe that moved by less leaves the pose exactly as it was said


def anchored(pose: Pose, map: Map | None) -> Pose:
    """The pose hung on its reference keyframe's newest `T_world_camera`; the very pose that was said when that has not moved, or there is none."""
    if map is None or not 0 <= pose.reference < len(map.keyframes):
        return pose
    T_world_keyframe = map.keyframes.row("T_world_camera", pose.reference)
    relative = invert(T_world_keyframe) @ pose.T_world_camera
    if np.abs(relative - pose.T_reference_camera).max() < UNMOVED:
        return pose
    return replace(pose, T_world_camera=T_world_keyframe @ pose.T_reference_camera)


def anchored_before(previous: Rotation, pose: Pose | None, map: Map | None) -> tuple[Rotation, Pose | None]:
    """The previous rotation and pose, both turned with the pose's reference keyframe, by `R_anchored · R_saidᵀ` from the left: the camera and the
    Manhattan frames keep their angles to the landmarks about them."""
    if pose is None:
        return previous, None
    now = anchored(pose, map)
    if now is pose:
        return previous, pose
    turn = now.T_world_camera[:3, :3] @ pose.T_world_camera[:3, :3].T
    return replace(previous, R_world_camera=turn @ previous.R_world_camera, R_world_manhattan=turn @ previous.R_world_manhattan), now


# The pose as rotation and translation said it, before any refinement.

FIRST_SIGMA = 1e-6  # the first pose is exact by definition; positive, so that covariances stay invertible


@dataclass(frozen=True)
class Decoupled:
    """`T_world_camera` (4, 4) with covariance (6, 6) of xi, counts of points, lines and planes, and what is to be said of it."""

    T_world_camera: F64
    covariance: F64
    inliers: I32
    unobservable: int
    status: str
    reason: str

    def said(self, frame: Value, map: Map | None, reason: str = "", submap: int = 0) -> Pose:
        """As the frame's pose in a sub-map; `reason` says why no refinement followed (degraded, unless it was lost already)."""
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
    """The decoupled pose with its status. It is lost when nothing of this frame took part, and on top of a pose that was lost, however well the
    frames fit each other: a motion since nowhere leads nowhere. Where this frame was recognised in the map, it starts from there."""
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
        status, reason = LOST, "the place was not recognised since the pose was lost"
    return Decoupled(T, covariance, translation.inliers, unobservable, status, reason)


def _judge(rotation: Rotation, translation: Translation, unobservable: int) -> tuple[str, str]:
    if not translation.estimated:
        return LOST, "no feature of the previous frame was found again"
    if unobservable:
        return DEGRADED, f"{unobservable} directions of motion cannot be seen, held at the prediction"
    if rotation.source == "prediction":
        return DEGRADED, "the rotation was predicted, not measured"
    return OK, "{} points, {} lines and {} planes of the previous frame".format(*translation.inliers)


def reference_of(map: Map | None, T_world_camera: F64, submap: int = 0) -> tuple[int, F64]:
    """The newest living keyframe of the sub-map and the pose relative to it; (-1, T_world_camera) without one."""
    newest = keyframes_of(map, submap)[-1:] if map is not None else np.empty(0, np.int32)
    if map is None or len(newest) == 0:
        return -1, T_world_camera
    return int(newest[0]), invert(map.keyframes.row("T_world_camera", int(newest[0]))) @ T_world_camera
