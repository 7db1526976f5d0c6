"""What the keyframes of a map and their landmarks move by when a loop is closed, or when the building's directions say how the map has turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import exp_so3, invert, pose_matrix
from trihedron.pipeline.core.types import F32, F64, I32, Correction, Map, Table
from trihedron.plugins.numerics.algebra.uncertainty import inverse
from trihedron.plugins.numerics.maps.landmarks import ENDS, PLACE
from trihedron.plugins.numerics.maps.local_window import current_submap, keyframes_of
from trihedron.plugins.numerics.places.map_compass import Compass
from trihedron.plugins.numerics.places.pose_graph import Edges, joined, solve_pose_graph
from trihedron.plugins.numerics.planes.plane_fusion import information_of

LEAST_M, LEAST = 1e-3, 1e-4  # standard deviations between two keyframes at one place, m and rad
LINKS = 3  # further keyframes each is tied to, so that a stretch that was looked at often stays stiff
NOWHERE = 1e-6  # 1/m², information of where a direction is: none
POSSIBLE = 3.0  # standard deviations of the drift that directions may correct; beyond, they are those of another wing


@dataclass(frozen=True)
class Drift:
    """How fast keyframes that follow each other lose their way and their direction: standard deviations per square root of a metre walked, m and
    rad."""

    position: float
    rotation: float


@dataclass(frozen=True)
class Closure:
    """Keyframe `keyframe` was recognised from what keyframe `place` saw: its pose there, and the covariance of xi (camera frame)."""

    keyframe: int
    place: int
    T_world_camera: F64
    covariance: F64


def close(map: Map, closure: Closure, drift: Drift, compass: Compass | None) -> Correction:
    """The correction that lets every keyframe of the tracked sub-map move, and each landmark with the keyframes that saw it."""
    rows = keyframes_of(map, current_submap(map))
    before = map.keyframes.rows("T_world_camera", rows)
    place, keyframe = np.searchsorted(rows, [closure.place, closure.keyframe])
    measured = invert(before[place]) @ closure.T_world_camera
    closing = Edges(np.array([[place, keyframe]], np.int32), measured[None], np.linalg.inv(closure.covariance)[None])
    return moved_keyframes(map, rows, before, _solved(before, joined(_odometry(map, rows, before, drift), closing), compass))


def straighten(map: Map, drift: Drift, compass: Compass, least: float) -> Correction | None:
    """The correction that turns every keyframe back to the building's directions; None where the newest would turn by less than `least` (rad), or
    some keyframe by more than it can have drifted."""
    rows = compass.keyframes
    before = map.keyframes.rows("T_world_camera", rows)
    after = _solved(before, _odometry(map, rows, before, drift), compass)
    cosine = 0.5 * (np.einsum("kij,kij->k", before[:, :3, :3], after[:, :3, :3]) - 1.0)
    turned = np.arccos(np.clip(cosine, -1.0, 1.0))
    walked = np.linalg.norm(np.diff(before[:, :3, 3], axis=0), axis=1).sum()
    if turned[-1] < least or turned.max() > POSSIBLE * drift.rotation * np.sqrt(walked):
        return None
    return moved_keyframes(map, rows, before, after)


def _solved(before: F64, edges: Edges, compass: Compass | None) -> F64:
    """The keyframes' poses by a pose graph. The Manhattan frame is one more node, which every keyframe sees the direction of."""
    if compass is None:
        return solve_pose_graph(before, edges)
    count, axes = len(before), pose_matrix(compass.R_world_manhattan, np.zeros(3))
    seen = invert(axes) @ before
    seen[:, :3, :3] = seen[:, :3, :3] @ np.array([exp_so3(phi) for phi in compass.turns])
    information = np.zeros((count, 6, 6))
    information[:, :3, :3], information[:, 3:, 3:] = NOWHERE * np.eye(3), compass.information
    pairs = np.stack([np.full(count, count), np.arange(count)], axis=1).astype(np.int32)
    return solve_pose_graph(np.concatenate([before, axes[None]]), joined(edges, Edges(pairs, seen, information)))[:count]


def _odometry(map: Map, rows: I32, poses: F64, drift: Drift) -> Edges:
    """Between neighbours in time: an edge is as uncertain as the later keyframe's own pose plus the drift on the way."""
    pairs = np.concatenate([np.stack([np.arange(len(rows) - k), np.arange(k, len(rows))], axis=1) for k in range(1, LINKS + 1)])
    measured = invert(poses[pairs[:, 0]]) @ poses[pairs[:, 1]]
    length = np.linalg.norm(measured[:, :3, 3], axis=1)[:, None, None]
    covariance = LINKS * map.keyframes.rows("covariance", rows[pairs[:, 1]])
    covariance[:, :3, :3] += LINKS * (drift.position**2 * length + LEAST_M**2) * np.eye(3)
    covariance[:, 3:, 3:] += LINKS * (drift.rotation**2 * length + LEAST**2) * np.eye(3)
    return Edges(pairs.astype(np.int32), measured, np.linalg.inv(covariance))


def moved_keyframes(map: Map, rows: I32, before: F64, after: F64) -> Correction:
    """The correction that moves keyframes `rows` from poses (n, 4, 4) to others, and each landmark by the mean of those that saw it."""
    motions = np.broadcast_to(np.eye(4), (len(map.keyframes), 4, 4)).copy()
    motions[rows] = after @ invert(before)
    points, lines, planes = (_moving(table) for table in (map.points, map.lines, map.planes))
    T_points, T_lines, T_planes = (_mean_motion(*moving, motions) for moving in (points, lines, planes))
    coefficients = _moved_planes(T_planes, map.planes.rows("coefficients", planes[0]))
    return Correction(
        map.index,
        map.stamp_ns,
        map.revision,
        rows,
        after,
        points[0],
        PLACE.rounded(_moved(T_points, map.points.rows("position_m", points[0])[:, None])[:, 0]),
        _turned(T_points, map.points.rows("information", points[0])),
        lines[0],
        ENDS.rounded(_moved(T_lines, map.lines.rows("endpoints_m", lines[0]))),
        _turned(T_lines[:, None], map.lines.rows("information", lines[0])),
        planes[0],
        coefficients,
        inverse(information_of(T_planes @ map.planes.rows("moments", planes[0]) @ np.swapaxes(T_planes, 1, 2), coefficients)),
    )


def _moving(table: Table) -> tuple[I32, I32]:
    """Living landmarks and their observers (n, 16), -1 = none."""
    ids = np.flatnonzero(table.column("alive")).astype(np.int32)
    return ids, table.rows("observers", ids)


def _mean_motion(ids: I32, observers: I32, motions: F64) -> F64:
    """(n, 4, 4): the mean of the motions (k, 4, 4) of each landmark's observers; between motions that differ little it is one."""
    total, count = np.zeros((len(ids), 4, 4)), np.zeros(len(ids))
    for column in observers.T:
        known = column >= 0
        total[known] += motions[column[known]]
        count += known
    total[count == 0.0], count[count == 0.0] = np.eye(4), 1.0
    return total / count[:, None, None]


def _moved(T: F64, points: F64) -> F64:
    """(n, 4, 4) and (n, k, 3) -> (n, k, 3)."""
    return points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]


def _turned(T: F64, information: F32) -> F32:
    """(..., 4, 4) and (..., 3, 3): what is known of a place, turned with it."""
    return np.asarray(T[..., :3, :3] @ information @ np.swapaxes(T[..., :3, :3], -1, -2), np.float32)


def _moved_planes(T: F64, planes: F64) -> F64:
    """(n, 4, 4) and (n, 4) -> (n, 4)."""
    n = (T[:, :3, :3] @ planes[:, :3, None])[..., 0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.concatenate([n, planes[:, 3:] - np.einsum("ni,ni->n", n, T[:, :3, 3])[:, None]], axis=1)
