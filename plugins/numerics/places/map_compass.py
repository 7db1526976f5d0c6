"""The Manhattan frame of a whole map as a compass: what a building's walls and edges say of each keyframe's rotation, wherever it stands.

A map drifts, since each keyframe is tied to those just before it; directions repeat all through a building. Every plane and line of the map counts
once, at the keyframe in the middle of those that saw it, so that a wall that is not true errs once and not with each view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, Map, Table
from trihedron.plugins.numerics.algebra.uncertainty import inverse
from trihedron.plugins.numerics.axes.direction_information import measured_directions
from trihedron.plugins.numerics.axes.plane_axes import Walls, area_on_axes, known_walls, perpendicular_pair, settled
from trihedron.plugins.numerics.maps.local_window import current_submap, keyframes_of

WALLS = 60  # planes, those seen most often, that say which way the axes are
MAX_COS, LARGEST_COS = 0.05, 0.2  # of two walls at right angles, see `perpendicular_pair`
NO_MEANS = np.zeros((0, 3))


@dataclass(frozen=True)
class Trueness:
    """How true a building is: deviation of its walls and edges from the axes (standard deviations), the angle within which a direction belongs to an
    axis, the σ at which one counts half, and the share of the walls (by views) that must stand on the axes."""

    wall: float = np.radians(0.3)
    edge: float = np.radians(0.5)
    reach: float = np.radians(2.0)
    gate: float = 2.0
    explained: float = 0.5


@dataclass(frozen=True)
class Compass:
    """`R_world_manhattan` (3, 3), the keyframes' rows (k,) and, for each, phi of `R_world_camera · Exp(phi)` that lies best on the axes (k, 3) and
    how well it is known: information (k, 3, 3), zero about what the keyframe's directions do not tell."""

    R_world_manhattan: F64
    keyframes: I32
    turns: F64
    information: F64


def compass_of(map: Map, trueness: Trueness) -> Compass | None:
    """What the directions in the tracked sub-map say of its keyframes; None where no two axes have walls, or most walls are on none."""
    rows = keyframes_of(map, current_submap(map))
    planes, at_plane = _seen_in_the_middle(map.planes, rows)
    lines, at_line = _seen_in_the_middle(map.lines, rows)
    coefficients, covariance = map.planes.rows("coefficients", planes), map.planes.rows("covariance", planes)
    R = _axes(coefficients, covariance, map.planes.rows("found", planes), trueness)
    if R is None:
        return None
    vectors, information = measured_directions(
        coefficients,
        covariance,
        trueness.wall,
        map.lines.rows("endpoints_m", lines).astype(np.float32),
        inverse(map.lines.rows("information", lines)).astype(np.float32),
        trueness.edge,
        NO_MEANS,
        NO_MEANS[:, 0],
    )
    poses = map.keyframes.rows("T_world_camera", rows)
    return Compass(R, rows, *_turns(vectors, information, np.concatenate([at_plane, at_line]), R, poses, np.cos(trueness.reach), trueness.gate))


def _seen_in_the_middle(landmarks: Table, keyframes: I32) -> tuple[I32, I32]:
    """Living landmarks and, as places in `keyframes` (sorted), the middle one of those that saw each; without those seen by none of them."""
    ids = np.flatnonzero(landmarks.column("alive")).astype(np.int32)
    observers = np.sort(landmarks.rows("observers", ids), axis=1)
    count = (observers >= 0).sum(axis=1)
    middle = observers[np.arange(len(ids)), np.minimum(observers.shape[1] - count + count // 2, observers.shape[1] - 1)]
    place = np.minimum(np.searchsorted(keyframes, middle), len(keyframes) - 1)
    known = (count > 0) & (keyframes[place] == middle) if len(keyframes) else np.zeros(len(ids), np.bool_)
    return ids[known], place[known].astype(np.int32)


def _axes(planes: F64, covariance: F64, views: I32, trueness: Trueness) -> F64 | None:
    """R_world_manhattan through most views of the walls (n, 4), or None."""
    most = np.argsort(-views, kind="stable")[:WALLS]
    walls: Walls = known_walls(planes[most], covariance[most], views[most], trueness.wall)
    found, R = perpendicular_pair(walls, MAX_COS, LARGEST_COS, trueness.reach, np.eye(3), 1.0)
    if not found:
        return None
    on_axes = area_on_axes(walls, R, trueness.reach)
    if np.count_nonzero(on_axes) < 2 or on_axes.sum() < trueness.explained * walls.area.sum():
        return None
    settled_R: F64 = settled(walls, R, trueness.reach, trueness.gate, 0.0, 3)[0]
    return settled_R


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _turns(vectors: F64, information: F64, places: I32, R_world_manhattan: F64, poses: F64, least_cos: float, gate: float) -> tuple[F64, F64]:
    """(k, 3) and (k, 3, 3), see `Compass`, from world directions (n, 3) with their information, seen at the keyframes `places` (n,).

    A direction v and its axis e, both in the camera: `v - Exp(-phi) e = v - e + phi × e` to first order; Cauchy's weights."""
    k = len(poses)
    H, g, turns = np.zeros((k, 3, 3)), np.zeros((k, 3)), np.zeros((k, 3))
    S, A, e, r = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for i in range(len(vectors)):
        along = R_world_manhattan.T @ vectors[i]
        axis = np.argmax(np.abs(along))
        if not abs(along[axis]) > least_cos:  # NaN too
            continue
        R = np.ascontiguousarray(poses[places[i], :3, :3])
        e[:] = R.T @ (R_world_manhattan[:, axis] * np.sign(along[axis]))
        r[:] = R.T @ vectors[i] - e
        S[0, 1], S[0, 2], S[1, 0], S[1, 2], S[2, 0], S[2, 1] = e[2], -e[1], -e[2], e[0], e[1], -e[0]  # phi × e = S phi
        A[:] = R.T @ information[i] @ R
        weight = 1.0 / (1.0 + r @ A @ r / gate**2)
        H[places[i]] += weight * (S.T @ A @ S)
        g[places[i]] -= weight * (S.T @ (A @ r))
    for j in range(k):
        turns[j] = np.linalg.solve(H[j] + 1e-2 * np.eye(3), g[j])
    return turns, H
