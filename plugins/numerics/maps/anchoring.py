"""What was said before a correction of the map, as it stands in the map now.

A correction is applied at the end of a frame, after its pose was said. The pose names its reference keyframe and its place relative to it, and the
map's newest version says where that keyframe is: poses, and the world–Manhattan rotations tied to them, follow it without a jump.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.types import Map, Pose, Rotation

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
