"""A closed loop spread over the map: what the keyframes between its ends and their landmarks move by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.geometry import invert
from trihedron.pipeline.types import F64, I32, Correction, Map, Table
from trihedron.plugins.numerics.algebra.uncertainty import inverse
from trihedron.plugins.numerics.maps.local_window import current_submap, keyframes_of
from trihedron.plugins.numerics.places.pose_graph import Edges, solve_pose_graph
from trihedron.plugins.numerics.planes.plane_fusion import information_of

LEAST_M, LEAST = 1e-3, 1e-4  # standard deviations between two keyframes at one place, m and rad
LINKS = 3  # further keyframes each is tied to, so that a stretch that was looked at often stays stiff


@dataclass(frozen=True)
class Drift:
    """How fast keyframes that follow each other lose their way, as standard deviations: per square root of a metre walked, and that of a rotation
    however long the walk, since the Manhattan frame holds it. What the rotation is off by changes slowly, so all keyframes tell it but once."""

    share: float
    rotation_sigma: float


@dataclass(frozen=True)
class Closure:
    """Keyframe `keyframe` was recognised from what keyframe `place` saw: its pose there, and the covariance of xi (camera frame)."""

    keyframe: int
    place: int
    T_world_camera: F64
    covariance: F64


def close(map: Map, closure: Closure, drift: Drift) -> Correction:
    """The correction that lets every keyframe of the tracked sub-map move, and each landmark with the keyframes that saw it."""
    rows = keyframes_of(map, current_submap(map))
    before = map.keyframes.rows("T_world_camera", rows)
    edges = _edges(map, rows, before, closure, drift)
    after = solve_pose_graph(before, edges, before[:, :3, :3], drift.rotation_sigma * np.sqrt(len(rows)))
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
        _moved(T_points, map.points.rows("position_m", points[0])[:, None])[:, 0],
        _turned(T_points, map.points.rows("information", points[0])),
        lines[0],
        _moved(T_lines, map.lines.rows("endpoints_m", lines[0])),
        _turned(T_lines[:, None], map.lines.rows("information", lines[0])),
        planes[0],
        coefficients,
        inverse(information_of(T_planes @ map.planes.rows("moments", planes[0]) @ np.swapaxes(T_planes, 1, 2), coefficients)),
    )


def _edges(map: Map, rows: I32, poses: F64, closure: Closure, drift: Drift) -> Edges:
    """Odometry between neighbours in time, and the closure. An edge is as uncertain as the keyframe's own pose plus the drift on the way."""
    pairs = [np.stack([np.arange(len(rows) - k), np.arange(k, len(rows))], axis=1) for k in range(1, LINKS + 1)]
    odometry = np.concatenate(pairs)
    measured = invert(poses[odometry[:, 0]]) @ poses[odometry[:, 1]]
    length = np.linalg.norm(measured[:, :3, 3], axis=1)
    covariance = LINKS * map.keyframes.rows("covariance", rows[odometry[:, 1]])
    covariance[:, :3, :3] += LINKS * (drift.share**2 * length + LEAST_M**2)[:, None, None] * np.eye(3)
    walked = length[: len(rows) - 1].sum()
    covariance[:, 3:, 3:] += LINKS * (drift.rotation_sigma**2 * length / walked + LEAST**2)[:, None, None] * np.eye(3)
    place, keyframe = np.searchsorted(rows, [closure.place, closure.keyframe])
    return Edges(
        np.concatenate([odometry, [[place, keyframe]]]).astype(np.int32),
        np.concatenate([measured, [invert(poses[place]) @ closure.T_world_camera]]),
        np.linalg.inv(np.concatenate([covariance, closure.covariance[None]])),
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


def _turned(T: F64, information: F64) -> F64:
    """(..., 4, 4) and (..., 3, 3): what is known of a place, turned with it."""
    return np.asarray(T[..., :3, :3] @ information @ np.swapaxes(T[..., :3, :3], -1, -2), np.float64)


def _moved_planes(T: F64, planes: F64) -> F64:
    """(n, 4, 4) and (n, 4) -> (n, 4)."""
    n = (T[:, :3, :3] @ planes[:, :3, None])[..., 0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.concatenate([n, planes[:, 3:] - np.einsum("ni,ni->n", n, T[:, :3, 3])[:, None]], axis=1)
