"""Applying a correction, found from an earlier version of the map, to the newest one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.geometry import invert, transform, transform_planes
from trihedron.pipeline.types import F64, I32, Bool, Correction, Map, Table
from trihedron.plugins.numerics import plane_fusion
from trihedron.plugins.numerics.uncertainty import inverse


def apply_correction(map: Map, correction: Correction) -> Map:
    """Move keyframes and landmarks to where the correction says. Rows that died since are left out; keyframes inserted since the correction's
    revision, and landmarks first seen by them, move with the newest keyframe that was corrected."""
    known = correction.keyframe_ids < len(map.keyframes)
    ids, poses = correction.keyframe_ids[known], correction.T_world_keyframe[known]
    if len(ids):
        map = _carry(map, correction, int(ids.max()), poses[np.argmax(ids)])
        map = replace(map, keyframes=map.keyframes.updated(ids, T_world_camera=poses))
    rows = _living(map.points, correction.point_ids)
    points = map.points.updated(correction.point_ids[rows], position_m=correction.points_m[rows])
    rows = _living(map.lines, correction.line_ids)
    lines = map.lines.updated(correction.line_ids[rows], endpoints_m=correction.endpoints_m[rows])
    rows = _living(map.planes, correction.plane_ids)
    planes = _move_planes(map.planes, correction.plane_ids[rows], correction.coefficients[rows])
    return replace(map, points=points, lines=lines, planes=planes)


def _living(table: Table, ids: I32) -> Bool:
    """Which of the ids are rows of the table that are alive."""
    inside = (ids >= 0) & (ids < len(table))
    inside[inside] = table.rows("alive", ids[inside])
    return inside


def _carry(map: Map, correction: Correction, newest: int, T_corrected: F64) -> Map:
    """Move what came after the newest corrected keyframe along with it."""
    later = np.arange(newest + 1, len(map.keyframes), dtype=np.int32)
    if not len(later):
        return map
    T = T_corrected @ invert(map.keyframes.rows("T_world_camera", np.array([newest]))[0])
    points = _born_after(map.points, newest, correction.point_ids)
    lines = _born_after(map.lines, newest, correction.line_ids)
    return carried(map, T, later, points, lines, _born_after(map.planes, newest, correction.plane_ids))


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
    changes["planes"] = _move_planes(map.planes, planes, transform_planes(T, map.planes.rows("coefficients", planes)), T)
    return replace(map, **changes)


def _born_after(table: Table, keyframe: int, corrected: I32) -> I32:
    """Living landmarks first seen after the keyframe, but for those the correction moves itself."""
    ids = np.flatnonzero((table.column("first") > keyframe) & table.column("alive")).astype(np.int32)
    return ids[~np.isin(ids, corrected)]


def _move_planes(table: Table, ids: I32, coefficients: F64, T: F64 | None = None) -> Table:
    """Give planes new coefficients, with their moments and samples carried along by T or by the smallest motion between old and new plane."""
    old, moments, samples = table.rows("coefficients", ids), table.rows("moments", ids), table.rows("samples_m", ids)
    for k in range(len(ids)):
        motion = plane_fusion.motion_between(old[k], coefficients[k], moments[k, :3, 3] / moments[k, 3, 3]) if T is None else T
        moments[k] = plane_fusion.move_moments(motion, moments[k])
        samples[k] = transform(motion, samples[k])
    covariance = inverse(plane_fusion.information_of(moments, coefficients))
    return table.updated(ids, coefficients=coefficients, covariance=covariance, moments=moments, samples_m=samples)
