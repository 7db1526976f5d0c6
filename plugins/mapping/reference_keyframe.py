"""Poses relative to their reference keyframes.

A correction of the map is applied at the end of a frame, after its pose was estimated. The pose is stored relative to its reference keyframe, and so
is its sensitivity to the calibration, so that poses, and the world–Manhattan rotations estimated with them, follow a corrected keyframe without a
jump.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.core.geometry import invert, rigid
from trihedron.pipeline.core.lie import adjoint
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, Map, Pose, Rotation
from trihedron.plugins.mapping.covisibility_graph import keyframes_of
from trihedron.plugins.mapping.landmarks import ALIGNMENT, KEYFRAMES
from trihedron.plugins.shared.calibration_error import calibration_covariance

UNMOVED = 1e-12  # rad and m: rounding; a keyframe that moved by less leaves the pose unchanged


def transform_to_map(pose: Pose, map: Map | None) -> Pose:
    """Re-express a pose through its reference keyframe's newest `T_world_camera`; the same object when that has not moved, or there is none."""
    if map is None or not 0 <= pose.reference < len(map.keyframes):
        return pose
    T_world_keyframe = map.keyframes.row("T_world_camera", pose.reference)
    relative = matmul(invert(T_world_keyframe), pose.T_world_camera)
    if np.abs(relative - pose.T_reference_camera).max() < UNMOVED:
        return pose
    sensitivity = _reference_sensitivity(pose, map) + pose.relative_sensitivity
    moved = replace(pose, T_world_camera=rigid(matmul(T_world_keyframe, pose.T_reference_camera)), sensitivity=sensitivity)
    change = calibration_covariance(moved) - calibration_covariance(pose)
    return replace(moved, covariance=pose.covariance + change, map_covariance=pose.map_covariance + change)


def with_relative_sensitivity(pose: Pose, map: Map) -> Pose:
    """Give a pose what its sensitivity to the calibration has more than that of its reference keyframe; zero without one."""
    if not 0 <= pose.reference < len(map.keyframes):
        return pose
    return replace(pose, relative_sensitivity=pose.sensitivity - _reference_sensitivity(pose, map))


def alignment_of_reference(pose: Pose, map: Map) -> dict[str, F64]:
    """Return what alignments with the Manhattan frame have done to a keyframe at the pose, its columns `ALIGNMENT`: the same as to the reference
    keyframe that it moves rigidly with, and nothing without one."""
    known = 0 <= pose.reference < len(map.keyframes)
    return {name: _carried(pose, map, name) if known else np.zeros(KEYFRAMES[name].shape) for name in ALIGNMENT}


def _reference_sensitivity(pose: Pose, map: Map) -> F64:
    """The sensitivity (6, 12) to the calibration of a camera that moves rigidly with the pose's reference keyframe."""
    return _carried(pose, map, "sensitivity")


def _carried(pose: Pose, map: Map, name: str) -> F64:
    """A column (6,) or (6, m) of the reference keyframe, of xi in its frame, for a camera that moves with it."""
    return np.asarray(matmul(adjoint(invert(pose.T_reference_camera)), map.keyframes.row(name, pose.reference)))


def transform_rotation_to_map(previous: Rotation, pose: Pose | None, map: Map | None) -> tuple[Rotation, Pose | None]:
    """Rotate the previous rotation and pose with the pose's reference keyframe, by `R_new · R_oldᵀ` from the left: the camera and the Manhattan
    frames keep their angles to the landmarks near them."""
    if pose is None:
        return previous, None
    now = transform_to_map(pose, map)
    if now is pose:
        return previous, pose
    rotate = matmul(now.T_world_camera[:3, :3], pose.T_world_camera[:3, :3].T)
    return replace(
        previous, R_world_camera=matmul(rotate, previous.R_world_camera), R_world_manhattan=matmul(rotate, previous.R_world_manhattan)
    ), now


def submap_of(pose: Pose, map: Map | None) -> int:
    """Return the sub-map of a pose: that of its reference keyframe in the newest map."""
    if map is None or not 0 <= pose.reference < len(map.keyframes):
        return pose.submap
    return int(map.keyframes.row("submap", pose.reference))


def reference_of(map: Map | None, T_world_camera: F64, submap: int = 0) -> tuple[int, F64]:
    """Return the newest living keyframe of the sub-map and the pose relative to it; (-1, T_world_camera) without one."""
    newest = keyframes_of(map, submap)[-1:] if map is not None else np.empty(0, np.int32)
    if map is None or len(newest) == 0:
        return -1, T_world_camera
    return int(newest[0]), matmul(invert(map.keyframes.row("T_world_camera", int(newest[0]))), T_world_camera)
