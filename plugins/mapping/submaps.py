"""Sub-maps: parts of the map in separate worlds, made while the camera was lost, and their rigid merging once a place is recognised.

A camera that was lost may be found again where it is not: in a room that looks like the one it was lost in. What it maps from then on is split off
the map once it misses what the map holds there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import adjoint_between
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Map, Pose, Table
from trihedron.plugins.mapping.correction import transform_landmarks
from trihedron.plugins.mapping.covisibility_graph import keyframes_of
from trihedron.plugins.mapping.landmark_kinds import KINDS, LandmarkKind, landmarks_of, observations_of, observed_rows, with_tables
from trihedron.plugins.mapping.landmarks import distinct, index_of, isin, newest_first
from trihedron.plugins.mapping.merging import fuse_planes
from trihedron.plugins.mapping.reference_keyframe import submap_of

MOST_MISSING = 0.95  # of what was mapped before; at most 0.90 in nine sequences that see what they mapped, at least 0.98 in another place


def merge_submaps(map: Map, pose: Pose, recognised: Pose, max_deg: float, max_m: float) -> Map:
    """Move the sub-map of `pose` rigidly to the pose at which the same frame was `recognised` in another sub-map, which absorbs it. Identical planes
    of the two are fused now, points and lines when they are next observed."""
    submap = submap_of(pose, map)
    if submap == recognised.submap:
        return map
    rows = np.flatnonzero(map.keyframes.column("submap") == submap).astype(np.int32)
    T: F64 = matmul(recognised.T_world_camera, invert(pose.T_world_camera))
    map = transform_landmarks(map, T, rows, *(_created_by(table, rows) for table in (map.points, map.lines, map.planes)))
    newer, older = (_created_by(map.planes, keyframes_of(map, number)) for number in (submap, recognised.submap))
    submaps, covariance = np.full(len(rows), recognised.submap, np.int32), _world_covariance(map, rows, recognised)
    sensitivity = _sensitivity(map, rows, pose, recognised)
    changes: dict[str, Any] = {"keyframes": map.keyframes.updated(rows, submap=submaps, world_covariance=covariance, sensitivity=sensitivity)}
    return fuse_planes(replace(map, **changes), older, newer, max_deg, max_m)


def is_elsewhere(pose: Pose) -> bool:
    """Return True for a pose that misses nearly all that was mapped before the camera was lost: it was found again in another place."""
    return pose.missing > MOST_MISSING


def split_submap(map: Map, pose: Pose) -> Map:
    """Split what was mapped since the camera was lost off the rest of the map, as a sub-map of its own, whose world has the poses that it had.
    Landmarks that both observed are two from then on. The same map where the pose is relative to an older keyframe, and would not go with it."""
    submaps, index = map.keyframes.column("submap"), map.keyframes.column("index")
    rows = np.flatnonzero((submaps == submap_of(pose, map)) & (index >= pose.lost_from)).astype(np.int32)
    if pose.reference not in rows:
        return map
    keyframes = map.keyframes.updated(rows, submap=np.full(len(rows), submaps.max() + 1, np.int32))
    tables, observations = landmarks_of(map), observations_of(map)
    for kind in KINDS:
        tables[kind], observations[kind] = _split(map, rows, kind)
    return with_tables(replace(map, keyframes=keyframes), tables, observations)


def _split(map: Map, keyframes: I32, kind: LandmarkKind) -> tuple[Table, Table]:
    """The landmarks of a kind and their observations, with a copy of each that some of the keyframes and others observed, for the former."""
    table, observations = landmarks_of(map)[kind], observations_of(map)[kind]
    rows, ids, counts = observed_rows(map, keyframes, kind)
    living = table.rows("alive", ids) & ~isin(table.rows("first", ids), keyframes)
    rows, ids, observers = rows[living], ids[living], np.repeat(keyframes, counts)[living]
    shared = distinct(ids)
    number = index_of(ids, shared)
    first = np.full(len(shared), len(map.keyframes), np.int32)
    np.minimum.at(first, number, observers)
    known = table.rows("observers", shared)
    mine = np.isin(known, keyframes)
    columns = dict(zip(table.schema, table.columns_at(shared, *table.schema)))
    columns |= {"first": first, "observers": newest_first(np.where(mine, known, -1))}
    table, copies = table.updated(shared, observers=newest_first(np.where(mine, -1, known))).appended(**columns)
    return table, observations.updated(rows, **{kind.id_column: copies[number]})


def _world_covariance(map: Map, rows: I32, recognised: Pose) -> F64:
    """Covariances (k, 6, 6) of keyframes in the world that their sub-map is merged into: their own, plus that of the recognised pose, which they all
    move with, relative to a keyframe of that world, and of this keyframe."""
    poses, covariance = (map.keyframes.rows(name, rows) for name in ("T_world_camera", "world_covariance"))
    to_rows = adjoint_between(poses, recognised.T_world_camera)
    common = recognised.covariance
    if recognised.reference >= 0:
        T, of_reference = (map.keyframes.rows(name, np.array([recognised.reference]))[0] for name in ("T_world_camera", "world_covariance"))
        to_pose = adjoint_between(recognised.T_world_camera, T)
        common = common + matmul(to_pose, of_reference, to_pose.T)
    return np.asarray(covariance + matmul(to_rows, common, to_rows.transpose(0, 2, 1)))


def _sensitivity(map: Map, rows: I32, pose: Pose, recognised: Pose) -> F64:
    """Sensitivities (k, 6, m) of keyframes in the world that their sub-map is merged into: their own, plus what the recognised pose has more than
    this frame's in the sub-map's world."""
    poses, own = (map.keyframes.rows(name, rows) for name in ("T_world_camera", "sensitivity"))
    common = -pose.sensitivity
    if recognised.reference >= 0:
        T, of_reference = (map.keyframes.rows(name, np.array([recognised.reference]))[0] for name in ("T_world_camera", "sensitivity"))
        common = common + matmul(adjoint_between(recognised.T_world_camera, T), of_reference)
    return np.asarray(own + matmul(adjoint_between(poses, recognised.T_world_camera), common))


def _created_by(table: Table, keyframes: I32) -> I32:
    """Living landmarks that these keyframes created."""
    return np.flatnonzero(table.column("alive") & np.isin(table.column("first"), keyframes)).astype(np.int32)
