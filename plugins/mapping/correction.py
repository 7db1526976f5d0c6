"""Corrections of bundle adjustment and loop closing, estimated from an earlier version of the map and applied to the newest one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.geometry import invert, rigid, transform, transform_each, transform_planes
from trihedron.pipeline.core.lie import adjoint_between
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Bool, Correction, Map, Table
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.mapping.landmark_kinds import LINE, PLANE, POINT, LandmarkKind, landmarks_of
from trihedron.plugins.mapping.landmarks import ALIGNMENT, isin
from trihedron.plugins.mapping.plane_fusion import equivalent_moments, motions_between
from trihedron.plugins.shared.covariances import transform_plane_covariance


def apply_correction(map: Map, correction: Correction) -> Map:
    """Move keyframes and landmarks to their corrected poses and positions, and replace their information. Rows that died since are skipped.

    Keyframes inserted since the correction's revision, and landmarks created by them, move with the newest corrected keyframe. Culled keyframes,
    which poses still refer to, move with the nearest living one. An observation made since of a corrected landmark takes part in the next
    adjustment."""
    known = correction.keyframe_ids < len(map.keyframes)
    ids, poses = correction.keyframe_ids[known], correction.T_world_keyframe[known]
    if len(ids):
        last, later = int(np.argmax(ids)), _later(map, int(ids.max()))
        map = _correct_errors(map, correction, ids, last, later, known)
        map = _move_culled(map, ids, poses)
        map = _move_later(map, correction, int(ids[last]), later, poses[last])
        map = replace(map, keyframes=map.keyframes.updated(ids, T_world_camera=poses))
    rows = _living(map.points, correction.point_ids)
    points = map.points.updated(correction.point_ids[rows], position_m=correction.points_m[rows], information=correction.point_information[rows])
    rows = _living(map.lines, correction.line_ids)
    lines = map.lines.updated(correction.line_ids[rows], endpoints_m=correction.endpoints_m[rows], information=correction.line_information[rows])
    rows = _living(map.planes, correction.plane_ids)
    planes = _moved_planes(map.planes, correction.plane_ids[rows], correction.coefficients[rows], correction.plane_covariance[rows])
    return replace(map, points=points, lines=lines, planes=planes)


def _correct_errors(map: Map, correction: Correction, ids: I32, last: int, later: I32, known: Bool) -> Map:
    """Give keyframes `ids`, those of the correction that are `known`, what it states of their errors. The `later` keyframes still differ from the
    newest of these, `ids[last]`, as they did."""
    to_later = adjoint_between(map.keyframes.rows("T_world_camera", later), map.keyframes.row("T_world_camera", int(ids[last])))
    rows, changed = np.concatenate([ids, later]), dict[str, F64]()
    for name in ("sensitivity", *ALIGNMENT):
        given: F64 = getattr(correction, name)
        if len(given) != len(known):
            continue
        new, own, old = given[known], map.keyframes.rows(name, later), map.keyframes.row(name, int(ids[last]))
        changed[name] = np.concatenate([new, own + matmul(to_later, new[last] - old)])
    if len(correction.undone):
        map = replace(map, calibration_errors=correction.calibration_errors)
    return replace(map, keyframes=map.keyframes.updated(rows, **changed)) if changed else map


def _later(map: Map, newest: int) -> I32:
    """Keyframes of the same sub-map that were inserted after this one."""
    later = np.arange(newest + 1, len(map.keyframes), dtype=np.int32)
    return np.asarray(later[map.keyframes.rows("submap", later) == map.keyframes.row("submap", newest)])


def _living(table: Table, ids: I32) -> Bool:
    """True for the ids that are living rows of the table."""
    inside = (ids >= 0) & (ids < len(table))
    inside[inside] = table.rows("alive", ids[inside])
    return inside


def _move_culled(map: Map, ids: I32, poses: F64) -> Map:
    """Move each culled keyframe that is neither corrected nor newer than all corrected ones with the nearest living one of its sub-map, in position
    and direction: it was culled because others observe the same."""
    alive, submap, T_world = (map.keyframes.column(name) for name in ("alive", "submap", "T_world_camera"))
    culled = np.flatnonzero(~alive[: ids.max()]).astype(np.int32)
    culled = culled[~isin(culled, ids)]
    living = np.flatnonzero(alive)
    if not len(culled) or not len(living):
        return map
    away = np.linalg.norm(T_world[culled, None, :3, 3] - T_world[living, :3, 3], axis=-1) - matmul(T_world[culled, :3, 2], T_world[living, :3, 2].T)
    nearest = living[np.argmin(np.where(submap[culled, None] == submap[living], away, np.inf), axis=1)]
    moving = np.isin(nearest, ids) & (submap[nearest] == submap[culled])
    culled, nearest = culled[moving], nearest[moving]
    order = np.argsort(ids)
    T = matmul(poses[order[np.searchsorted(ids[order], nearest)]], invert(T_world[nearest]))
    return replace(map, keyframes=map.keyframes.updated(culled, T_world_camera=matmul(T, T_world[culled])))


def _move_later(map: Map, correction: Correction, newest: int, later: I32, T_corrected: F64) -> Map:
    """Move what was added after the newest corrected keyframe, in its sub-map, along with it: the `later` keyframes and their landmarks."""
    if not len(later):
        return map
    T = rigid(matmul(T_corrected, invert(map.keyframes.row("T_world_camera", newest))))
    corrected = {POINT: correction.point_ids, LINE: correction.line_ids, PLANE: correction.plane_ids}
    return transform_landmarks(map, T, later, *(_created_after(map, kind, newest, later, ids) for kind, ids in corrected.items()))


def transform_landmarks(map: Map, T: F64, keyframes: I32, points: I32, lines: I32, planes: I32) -> Map:
    """Move these rows of the map rigidly by T (4, 4, from the left), and rotate their information."""
    R = T[:3, :3]
    changes: dict[str, Any] = {
        "keyframes": map.keyframes.updated(keyframes, T_world_camera=matmul(T, map.keyframes.rows("T_world_camera", keyframes)))
    }
    information = matmul(R, map.points.rows("information", points), R.T)
    direction = matmul(map.points.rows("direction", points), R.T).astype(np.float32)
    position = transform(T, map.points.rows("position_m", points))
    changes["points"] = map.points.updated(points, position_m=position, information=information, direction=direction)
    information = matmul(R, map.lines.rows("information", lines), R.T)
    changes["lines"] = map.lines.updated(lines, endpoints_m=transform(T, map.lines.rows("endpoints_m", lines)), information=information)
    old = map.planes.rows("coefficients", planes)
    new = transform_planes(T, old)
    covariance = transform_plane_covariance(T, old, new, map.planes.rows("covariance", planes))
    changes["planes"] = _moved_planes(map.planes, planes, new, covariance, T)
    return replace(map, **changes)


def _created_after(map: Map, kind: LandmarkKind, keyframe: int, later: I32, corrected: I32) -> I32:
    """Living landmarks created after the keyframe, by one of those later, without the corrected ones."""
    ids = observed_by(map, later, kind)
    ids = ids[landmarks_of(map)[kind].rows("first", ids) > keyframe]
    return np.asarray(ids[~isin(ids, corrected)])


def _moved_planes(table: Table, ids: I32, coefficients: F64, covariance: F64, T: F64 | None = None) -> Table:
    """Give planes new coefficients and covariance, as if these were one measurement. Their samples move by T, or by the smallest motion between old
    and new plane."""
    old, samples, moments = table.columns_at(ids, "coefficients", "samples_m", "moments")
    if T is None:
        motions = motions_between(old, coefficients, moments[:, :3, 3] / moments[:, 3, 3:])
    else:
        motions = np.broadcast_to(T, (len(ids), 4, 4))
    moments = equivalent_moments(coefficients, covariance)
    return table.updated(ids, coefficients=coefficients, covariance=covariance, moments=moments, samples_m=transform_each(motions, samples))
