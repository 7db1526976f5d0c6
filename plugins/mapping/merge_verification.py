"""Verification of a merge: sub-maps are merged when several keyframes of one were recognised in the other and agree on the motion between the worlds.

One recognition may be wrong where a building repeats itself, and a wrong merge bends the map for good. Wrong recognitions of different views rarely
agree. A proposal is stored relative to a keyframe of each sub-map, so that it follows corrections of both.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import numpy as np

from trihedron.pipeline.core.geometry import invert, rigid
from trihedron.pipeline.core.lie import adjoint, exp_se3, log_se3, rotation_angle_deg
from trihedron.pipeline.core.linalg import inv_symmetric, matmul, solve
from trihedron.pipeline.core.types import F64, I32, Map, Pose
from trihedron.plugins.mapping.reference_keyframe import submap_of

CHI2_99 = 16.812  # 99 % limit of χ² with 6 degrees of freedom
FLOOR = np.diag(np.repeat(np.square([0.02, np.deg2rad(1.0)]), 3))  # (2 cm)² and (1°)²: drift of both sub-maps between two recognitions
VIEW_M, VIEW_DEG = 0.05, 2.0  # that the camera moves between two views: recognitions from nearer ones err alike
LOOK_FRAMES = 15  # after a proposal, in which each frame looks for more
MAX_AGE = 300  # frames after which a proposal no longer counts


def propose_merge(map: Map, pose: Pose, recognised: Pose, verified_by: int) -> tuple[Map, Pose | None]:
    """Add to the map's proposals that the frame of `pose` was `recognised` in an older sub-map.

    Returns:
        The map, and the pose of this frame in the older sub-map by the mean of the latest `verified_by` proposals if every two of them agree, else
        None. A frame that is not relative to a keyframe of each, or repeats the view of the latest proposal, adds nothing."""
    submap = submap_of(pose, map)
    if min(pose.reference, recognised.reference) < 0 or submap == recognised.submap:
        return map, None
    recent = _recent_proposals(map, pose.index)
    earlier = _between(map, recent, submap, recognised.submap)
    if _repeats(map, earlier[-1:], pose):
        return map, None
    map, row = _add_proposal(map, recent, pose, recognised)
    latest = np.append(earlier, row)[-verified_by:]
    if len(latest) < verified_by:
        return map, None
    poses, covariances = _predict_poses(map, latest, pose)
    if not all(_agree(poses[[i, j]], covariances[i] + covariances[j]) for i, j in combinations(range(verified_by), 2)):
        return map, None
    return map, _mean(map, recognised, poses, covariances)


def _recent_proposals(map: Map, index: int) -> I32:
    age = index - map.proposals.column("index")
    return np.flatnonzero((age > 0) & (age <= MAX_AGE)).astype(np.int32)


def proposed_submaps(map: Map, submap: int, index: int) -> I32:
    """Older sub-maps that one of the last LOOK_FRAMES frames proposed to merge a sub-map with."""
    if not len(map.proposals):  # in nearly all runs
        return np.empty(0, np.int32)
    recent = _recent_proposals(map, index)
    recent = recent[index - map.proposals.rows("index", recent) <= LOOK_FRAMES]
    of, older = (map.keyframes.rows("submap", ids) for ids in map.proposals.columns_at(recent, "keyframe", "older_keyframe"))
    return np.unique(older[(of == submap) & (older != submap)]).astype(np.int32)


def _between(map: Map, rows: I32, submap: int, older: int) -> I32:
    """The `rows` of proposals between two sub-maps. Those of merged sub-maps are between none: both keyframes have the same number."""
    of, older_of = (map.keyframes.rows("submap", ids) for ids in map.proposals.columns_at(rows, "keyframe", "older_keyframe"))
    return np.asarray(rows[(of == submap) & (older_of == older)])


def _repeats(map: Map, latest: I32, pose: Pose) -> bool:
    """True where the latest proposal (at most one row) is of this frame's view."""
    keyframes, T_keyframe_camera = map.proposals.columns_at(latest, "keyframe", "T_keyframe_camera")
    T_camera = matmul(map.keyframes.rows("T_world_camera", keyframes), T_keyframe_camera)
    return any(math.hypot(*T[:3, 3]) < VIEW_M and rotation_angle_deg(T[:3, :3]) < VIEW_DEG for T in matmul(invert(T_camera), pose.T_world_camera))


def _add_proposal(map: Map, recent: I32, pose: Pose, recognised: Pose) -> tuple[Map, I32]:
    """Append this frame's proposal, and free the memory of those that are too old."""
    T_world = map.keyframes.rows("T_world_camera", np.array([pose.reference, recognised.reference], np.int32))
    T_camera = matmul(invert(T_world), np.stack([pose.T_world_camera, recognised.T_world_camera]))
    table, row = map.proposals.appended(
        index=np.array([pose.index]),
        keyframe=np.array([pose.reference]),
        older_keyframe=np.array([recognised.reference]),
        T_keyframe_camera=T_camera[:1],
        T_older_camera=T_camera[1:],
        covariance=(pose.local_covariance + recognised.covariance)[None],
    )
    used = np.append(recent, row)
    return replace(map, proposals=table.keeping(np.stack([used, used + 1], axis=1))), row


def _predict_poses(map: Map, rows: I32, pose: Pose) -> tuple[F64, F64]:
    """The pose (n, 4, 4) of this frame's camera in the older sub-map by each proposal, and its covariance (n, 6, 6), in this camera's frame."""
    names = "keyframe", "older_keyframe", "T_keyframe_camera", "T_older_camera", "covariance"
    keyframes, older, T_keyframe_camera, T_older_camera, covariance = map.proposals.columns_at(rows, *names)
    T_camera_here = matmul(invert(matmul(map.keyframes.rows("T_world_camera", keyframes), T_keyframe_camera)), pose.T_world_camera)
    to_here = adjoint(invert(T_camera_here))
    poses = matmul(map.keyframes.rows("T_world_camera", older), T_older_camera, T_camera_here)
    return np.asarray(poses), np.asarray(matmul(to_here, covariance, to_here.transpose(0, 2, 1)))


def _agree(poses: F64, covariance: F64) -> bool:
    """True where the Mahalanobis distance of two poses (2, 4, 4) is within the limit."""
    difference = log_se3(rigid(matmul(invert(poses[0]), poses[1])))
    return bool(matmul(difference, solve(covariance + FLOOR, difference)) <= CHI2_99)


def _mean(map: Map, recognised: Pose, poses: F64, covariances: F64) -> Pose:
    """The recognised pose at the mean of n poses, weighted by their information. They share landmarks, so that more of them are not more certain:
    their information is averaged, not added (covariance intersection)."""
    information = inv_symmetric(covariances) / len(poses)
    covariance = inv_symmetric(information.sum(axis=0))
    differences = np.stack([log_se3(rigid(matmul(invert(recognised.T_world_camera), pose))) for pose in poses])
    mean = matmul(covariance, matmul(information, differences[:, :, None]).sum(axis=0)[:, 0])
    T = rigid(matmul(recognised.T_world_camera, exp_se3(mean)))
    relative = matmul(invert(map.keyframes.row("T_world_camera", recognised.reference)), T)
    return replace(recognised, T_world_camera=T, T_reference_camera=relative, covariance=covariance)
