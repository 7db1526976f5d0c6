"""Applying a correction, found from an earlier version of the map, to the newest one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform, transform_planes
from trihedron.pipeline.core.types import F64, I32, Bool, Correction, Map, Table
from trihedron.plugins.mapping import plane_fusion
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.mapping.landmarks import among
from trihedron.plugins.shared.linalg import transform_plane_covariance


def apply_correction(map: Map, correction: Correction) -> Map:
    """Move keyframes and landmarks to where the correction says, known as well as it says. Rows that died since are left out; keyframes inserted
    since the correction's revision, and landmarks first seen by them, move with the newest keyframe that was corrected; culled keyframes, on which
    poses still hang, move with the living one nearest to them. A measurement made since of a landmark that is corrected is forgotten; its row remains
    for the next adjustment."""
    known = correction.keyframe_ids < len(map.keyframes)
    ids, poses = correction.keyframe_ids[known], correction.T_world_keyframe[known]
    if len(ids):
        map = _carry_culled(map, ids, poses)
        map = _carry(map, correction, int(ids.max()), poses[np.argmax(ids)])
        map = replace(map, keyframes=map.keyframes.updated(ids, T_world_camera=poses))
    rows = _living(map.points, correction.point_ids)
    points = map.points.updated(correction.point_ids[rows], position_m=correction.points_m[rows], information=correction.point_information[rows])
    rows = _living(map.lines, correction.line_ids)
    lines = map.lines.updated(correction.line_ids[rows], endpoints_m=correction.endpoints_m[rows], information=correction.line_information[rows])
    rows = _living(map.planes, correction.plane_ids)
    planes = _moved_planes(map.planes, correction.plane_ids[rows], correction.coefficients[rows], correction.plane_covariance[rows])
    return replace(map, points=points, lines=lines, planes=planes)


def _living(table: Table, ids: I32) -> Bool:
    """Which of the ids are rows of the table that are alive."""
    inside = (ids >= 0) & (ids < len(table))
    inside[inside] = table.rows("alive", ids[inside])
    return inside


def _carry_culled(map: Map, ids: I32, poses: F64) -> Map:
    """Move each culled keyframe that the correction does not name, and that is not newer than all it names, along with the living one of its sub-map
    that is nearest in place and direction: it was culled because others show what it did."""
    alive, submap, T_world = (map.keyframes.column(name) for name in ("alive", "submap", "T_world_camera"))
    culled = np.flatnonzero(~alive[: ids.max()]).astype(np.int32)
    culled = culled[~among(culled, ids)]
    living = np.flatnonzero(alive)
    if not len(culled) or not len(living):
        return map
    away = np.linalg.norm(T_world[culled, None, :3, 3] - T_world[living, :3, 3], axis=-1) - T_world[culled, :3, 2] @ T_world[living, :3, 2].T
    nearest = living[np.argmin(np.where(submap[culled, None] == submap[living], away, np.inf), axis=1)]
    moving = np.isin(nearest, ids) & (submap[nearest] == submap[culled])
    culled, nearest = culled[moving], nearest[moving]
    order = np.argsort(ids)
    place = order[np.searchsorted(ids[order], nearest)]
    T = poses[place] @ invert(T_world[nearest])
    return replace(map, keyframes=map.keyframes.updated(culled, T_world_camera=T @ T_world[culled]))


def _carry(map: Map, correction: Correction, newest: int, T_corrected: F64) -> Map:
    """Move what came after the newest corrected keyframe, in its sub-map, along with it."""
    later = np.arange(newest + 1, len(map.keyframes), dtype=np.int32)
    later = later[map.keyframes.rows("submap", later) == map.keyframes.rows("submap", np.array([newest]))]
    if not len(later):
        return map
    T = T_corrected @ invert(map.keyframes.row("T_world_camera", newest))
    points = _born_after(map, "point", newest, later, correction.point_ids)
    lines = _born_after(map, "line", newest, later, correction.line_ids)
    return carried(map, T, later, points, lines, _born_after(map, "plane", newest, later, correction.plane_ids))


def carried(map: Map, T: F64, keyframes: I32, points: I32, lines: I32, planes: I32) -> Map:
    """These rows of the map moved rigidly by T (4, 4, from the left), what is known of them turned with them."""
    R = T[:3, :3]
    changes: dict[str, Any] = {"keyframes": map.keyframes.updated(keyframes, T_world_camera=T @ map.keyframes.rows("T_world_camera", keyframes))}
    information = R @ map.points.rows("information", points) @ R.T
    direction = (map.points.rows("direction", points) @ R.T).astype(np.float32)
    position = transform(T, map.points.rows("position_m", points))
    changes["points"] = map.points.updated(points, position_m=position, information=information, direction=direction)
    information = R @ map.lines.rows("information", lines) @ R.T
    changes["lines"] = map.lines.updated(lines, endpoints_m=transform(T, map.lines.rows("endpoints_m", lines)), information=information)
    old = map.planes.rows("coefficients", planes)
    new = transform_planes(T, old)
    covariance = transform_plane_covariance(T, old, new, map.planes.rows("covariance", planes))
    changes["planes"] = _moved_planes(map.planes, planes, new, covariance, T)
    return replace(map, **changes)


def _born_after(map: Map, kind: str, keyframe: int, later: I32, corrected: I32) -> I32:
    """Living landmarks first seen after the keyframe, by one of those later, but for those the correction moves itself."""
    ids = observed_by(map, later, kind)
    ids = ids[getattr(map, f"{kind}s").rows("first", ids) > keyframe]
    return ids[~among(ids, corrected)]


def _moved_planes(table: Table, ids: I32, coefficients: F64, covariance: F64, T: F64 | None = None) -> Table:
    """Give planes new coefficients and covariance, as if they were one measurement. Their samples are carried along by T, or by the smallest motion
    between old and new plane."""
    old, samples, moments = table.gathered(ids, "coefficients", "samples_m", "moments")
    if T is None:
        motions = plane_fusion.motions_between(old, coefficients, moments[:, :3, 3] / moments[:, 3, 3:])
    else:
        motions = np.broadcast_to(T, (len(ids), 4, 4))
    samples = samples @ np.swapaxes(motions[:, :3, :3], 1, 2) + motions[:, None, :3, 3]
    moments = plane_fusion.equivalent_moments(coefficients, covariance)
    return table.updated(ids, coefficients=coefficients, covariance=covariance, moments=moments, samples_m=samples)
