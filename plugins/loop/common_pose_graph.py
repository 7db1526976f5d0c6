"""What the keyframes of a map and their landmarks move by when a loop is closed, or when the building's directions say how the map has turned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from trihedron.pipeline.core.geometry import exp_so3, invert, pose_matrix
from trihedron.pipeline.core.types import F32, F64, I32, Correction, Map, Table
from trihedron.plugins.mapping.covisibility_graph import current_submap, keyframes_of
from trihedron.plugins.mapping.landmarks import ENDS, PLACE
from trihedron.plugins.mapping.plane_fusion import information_of
from trihedron.plugins.shared.linalg import cross_matrices, inverse

if TYPE_CHECKING:  # imported where it is needed: SciPy is slow to load, and most runs close no loop
    from scipy.sparse import bsr_matrix

from trihedron.plugins.loop.common_pose_graph_kernels import turns_kernel
from trihedron.plugins.shared.manhattan_frames_kernels import Walls, area_on_axes, known_walls, measured_directions, perpendicular_pair, settled

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
    closing = Edges(np.array([[place, keyframe]], np.int32), measured[None], np.asarray(np.linalg.inv(closure.covariance), np.float64)[None])
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
    coefficients = _transform_planes(T_planes, map.planes.rows("coefficients", planes[0]))
    return Correction(
        map.index,
        map.stamp_ns,
        map.revision,
        rows,
        after,
        points[0],
        PLACE.rounded(_transform_points(T_points, map.points.rows("position_m", points[0])[:, None])[:, 0]),
        _rotate_information(T_points, map.points.rows("information", points[0])),
        lines[0],
        ENDS.rounded(_transform_points(T_lines, map.lines.rows("endpoints_m", lines[0]))),
        _rotate_information(T_lines[:, None], map.lines.rows("information", lines[0])),
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


def _transform_points(T: F64, points: F64) -> F64:
    """(n, 4, 4) and (n, k, 3) -> (n, k, 3)."""
    return points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]


def _rotate_information(T: F64, information: F32) -> F32:
    """(..., 4, 4) and (..., 3, 3): what is known of a place, turned with it."""
    return np.asarray(T[..., :3, :3] @ information @ np.swapaxes(T[..., :3, :3], -1, -2), np.float32)


def _transform_planes(T: F64, planes: F64) -> F64:
    """(n, 4, 4) and (n, 4) -> (n, 4)."""
    n = (T[:, :3, :3] @ planes[:, :3, None])[..., 0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.concatenate([n, planes[:, 3:] - np.einsum("ni,ni->n", n, T[:, :3, 3])[:, None]], axis=1)


# Poses from relative poses: a sparse Levenberg–Marquardt over a graph of keyframes (Grisetti et al., ITS Magazine 2010).

ITERATIONS, CONVERGED = 20, 1e-9  # squared length of a step, metres and radians, below which nothing moves any more
HELD = 1e12 * np.eye(6)  # information of a pose that stays
ROUGHEST = 1e8  # damping beyond which no step goes downhill


@dataclass(frozen=True)
class Edges:
    """Measured motions between nodes: `T_a_b = Z · Exp(xi)`, xi = (rho, phi) of the given information."""

    pairs: I32  # (e, 2) rows (a, b)
    measured: F64  # (e, 4, 4) Z
    information: F64  # (e, 6, 6)


def joined(*edges: Edges) -> Edges:
    """All of them."""
    pairs, measured, information = zip(*((e.pairs, e.measured, e.information) for e in edges))
    return Edges(np.concatenate(pairs), np.concatenate(measured), np.concatenate(information))


def solve_pose_graph(poses: F64, edges: Edges) -> F64:
    """(n, 4, 4) `T_world_node` that minimise the squared error of the edges, starting from `poses`. Node 0 stays where it is."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    damping, current = 1e-6, poses.copy()
    cost, H, g = _normal_equations(current, edges)
    for _ in range(ITERATIONS):
        scale = diags(H.diagonal())
        step = splu((H + damping * scale).tocsc()).solve(-g).reshape(-1, 6)
        step[0] = 0.0  # held by its weight but for rounding
        tried = _retract(current, step)
        new_cost, new_H, new_g = _normal_equations(tried, edges)
        if new_cost <= cost:
            current, cost, H, g, damping = tried, new_cost, new_H, new_g, max(damping / 10.0, 1e-9)
            if float((step**2).sum(axis=1).max()) < CONVERGED:
                break
        else:
            damping *= 100.0
            if damping > ROUGHEST:
                break
    return current


def _retract(poses: F64, steps: F64) -> F64:
    """Poses (n, 4, 4) with their frames moved by (rho, phi) (n, 6)."""
    out = poses.copy()
    out[:, :3, 3] += (poses[:, :3, :3] @ steps[:, :3, None])[..., 0]
    out[:, :3, :3] = poses[:, :3, :3] @ np.array([exp_so3(phi) for phi in steps[:, 3:]])
    return out


def _rotation_vectors(R: F64) -> F64:
    """(n, 3, 3) rotations below 180° -> (n, 3) rotation vectors."""
    axis = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0))
    return np.asarray(axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)[:, None])


def _normal_equations(poses: F64, edges: Edges) -> tuple[float, bsr_matrix, F64]:
    """Cost, (6n, 6n) approximate Hessian and (6n,) gradient of half the squared error."""
    a, b = edges.pairs.T
    R_a, R_b, R_z = poses[a, :3, :3], poses[b, :3, :3], edges.measured[:, :3, :3]
    R_a_t, R_z_t = np.swapaxes(R_a, 1, 2), np.swapaxes(R_z, 1, 2)
    t_a_b = (R_a_t @ (poses[b, :3, 3] - poses[a, :3, 3])[..., None])[..., 0]
    error = np.concatenate([(R_z_t @ (t_a_b - edges.measured[:, :3, 3])[..., None])[..., 0], _rotation_vectors(R_z_t @ R_a_t @ R_b)], axis=1)
    J_a, J_b = np.zeros((2, len(a), 6, 6))
    J_a[:, :3, :3], J_a[:, :3, 3:], J_a[:, 3:, 3:] = -R_z_t, R_z_t @ cross_matrices(t_a_b), -np.swapaxes(R_b, 1, 2) @ R_a
    J_b[:, :3, :3], J_b[:, 3:, 3:] = R_z_t @ R_a_t @ R_b, np.eye(3)
    W_a, W_b = np.swapaxes(J_a, 1, 2) @ edges.information, np.swapaxes(J_b, 1, 2) @ edges.information
    n = len(poses)
    blocks = np.concatenate([W_a @ J_a, W_a @ J_b, W_b @ J_a, W_b @ J_b, HELD[None]])
    rows, columns = np.concatenate([a, a, b, b, [0]]), np.concatenate([a, b, a, b, [0]])
    g = np.zeros((n, 6))
    np.add.at(g, a, (W_a @ error[..., None])[..., 0])
    np.add.at(g, b, (W_b @ error[..., None])[..., 0])
    cost = float(np.einsum("ei,eij,ej->", error, edges.information, error))
    return cost, _assembled(blocks, rows, columns, n), g.ravel()


def _assembled(blocks: F64, rows: I32, columns: I32, n: int) -> bsr_matrix:
    """(6n, 6n) sum of 6 × 6 blocks at rows and columns of blocks."""
    from scipy.sparse import bsr_matrix

    keys, where = np.unique(rows.astype(np.int64) * n + columns, return_inverse=True)
    total = np.zeros((len(keys), 6, 6))
    np.add.at(total, where, blocks)
    starts = np.searchsorted(keys // n, np.arange(n + 1))
    return bsr_matrix((total, keys % n, starts), shape=(6 * n, 6 * n))


# The Manhattan frame of a whole map as a compass: what a building's walls and edges say of each keyframe's rotation, wherever it stands.
#
# A map drifts, since each keyframe is tied to those just before it; directions repeat all through a building. Every plane and line of the map counts
# once, at the keyframe in the middle of those that saw it, so that a wall that is not true errs once and not with each view.

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
    return Compass(R, rows, *turns_kernel(vectors, information, np.concatenate([at_plane, at_line]), R, poses, np.cos(trueness.reach), trueness.gate))


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
