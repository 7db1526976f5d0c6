"""The Manhattan prior of a whole map, and the corrections that use it: pose graphs of loops, and alignment of the map with its axes.

Every keyframe is connected to those just before it, so a map drifts until a place is seen again; directions repeat all through a building. Every
plane and line of the map counts once, at the middle one of its observers, so that a wall off the axes errs once and not with each view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.lie import adjoint_between, exp_se3, exp_so3, log_se3
from trihedron.pipeline.core.linalg import inv, inv_symmetric, matmul
from trihedron.pipeline.core.types import CALIBRATION, F64, I32, Camera, Correction, Map, Table
from trihedron.plugins.loop.calibration_turn import CalibrationEstimate, estimate_calibration
from trihedron.plugins.loop.keyframe_correction import correct_keyframes
from trihedron.plugins.loop.manhattan_prior_kernels import Views, keyframe_rotations, line_turns, plane_turns
from trihedron.plugins.mapping.covisibility_graph import DriftOptions, current_submap, keyframes_of, odometry, revisits
from trihedron.plugins.mapping.landmarks import ALIGNMENT, index_of
from trihedron.plugins.shared.calibration_error import calibration_scales, sensitivity_covariance
from trihedron.plugins.shared.lie_kernels import log_so3_each
from trihedron.plugins.shared.manhattan_frames_kernels import (
    Walls,
    area_on_axes,
    known_walls,
    measured_directions,
    perpendicular_pair,
    refine_rotation,
)
from trihedron.plugins.shared.pose_graph import Edges, concatenate_edges, edge_errors, remaining_errors, solve_pose_graph
from trihedron.plugins.shared.pose_optimizer import PoseSolution

LINKS = 3  # further keyframes each is connected to, so that a stretch that was observed often stays stiff
UNKNOWN = 1e-6  # 1/m², information of the position of a direction: none
PLAUSIBLE = 3.0  # standard deviations of the drift that the prior may correct; beyond, the directions are those of another wing
WALLS = 60  # planes, those observed most often, from which the axes are estimated
MAX_COS, LARGEST_COS = 0.05, 0.2  # of two walls at right angles, see `perpendicular_pair`
WALL_SIGMA, EDGE_SIGMA = np.radians(0.3), np.radians(0.5)  # of walls and edges about the axes: no building is exactly Manhattan
REACH = np.radians(2.0)  # within which a direction belongs to an axis
PASSES = 3  # of aligning: a direction that one brings within REACH of an axis counts in the next
GATE = 2.0  # σ at which a robust weight is one half
EXPLAINED = 0.5  # share of the walls (by views) that must stand on the axes
NO_MEANS = np.zeros((0, 3))


@dataclass(frozen=True)
class Directions:
    """Directions of n planes and lines of a map with the axes `R_world_manhattan` (3, 3), whose `keyframes` (k,) are at `poses` (k, 4, 4): `vectors`
    (n, 3) of the world with their information (n, 3, 3), and `turns` (n, 3, 12), by which the calibration turns them in the frames of `observers`
    (n,), indices of keyframes, each the middle one of those that observed the landmark."""

    R_world_manhattan: F64
    keyframes: I32
    poses: F64
    vectors: F64
    information: F64
    turns: F64
    observers: I32


@dataclass(frozen=True)
class ManhattanPrior:
    """For each keyframe of the `directions`, phi of `R_world_camera · Exp(phi)` that agrees best with the axes (k, 3), and its information (k, 3, 3),
    zero about directions that the keyframe's landmarks do not observe.

    `sensitivity` (k, 3, 12) is the derivative by the calibration of the rotation of these landmarks, in the keyframe's frame: they turn with the
    poses that they were placed from, and since the same camera measured them."""

    directions: Directions
    rotations: F64
    information: F64
    sensitivity: F64


def estimate_manhattan_prior(map: Map, camera: Camera) -> ManhattanPrior | None:
    """Estimate the prior from the directions in the tracked sub-map; None where no two axes have walls, or most walls are on none."""
    rows = keyframes_of(map, current_submap(map))
    planes, at_plane = _middle_observers(map.planes, rows)
    lines, at_line = _middle_observers(map.lines, rows)
    coefficients, covariance = map.planes.rows("coefficients", planes), map.planes.rows("covariance", planes)
    poses, twists, sensitivity = map.keyframes.columns_at(rows, "T_world_camera", "twist", "sensitivity")
    expected = _expected(map, rows)
    R = estimate_axes(_moved_with(coefficients, matmul(expected, invert(poses))[at_plane]), covariance, map.planes.rows("found", planes))
    if R is None:
        return None
    ends, end_covariance = map.lines.rows("endpoints_m", lines), inv_symmetric(map.lines.rows("information", lines))
    vectors, information = measured_directions(
        coefficients, covariance, WALL_SIGMA, ends.astype(np.float32), end_covariance.astype(np.float32), EDGE_SIGMA, NO_MEANS, NO_MEANS[:, 0]
    )
    samples, seen_by = map.planes.columns_at(planes, "samples_m", "observers")
    views = Views(
        poses, twists, sensitivity, camera.intrinsics, camera.width, camera.height, calibration_scales(camera), camera.depth_noise.coefficients
    )
    of_planes = plane_turns(coefficients, samples, index_of(seen_by, rows), at_plane, views)
    of_lines = line_turns(ends, index_of(map.lines.rows("observers", lines), rows), at_line, views)
    turns, observers = np.concatenate([of_planes, of_lines]), np.concatenate([at_plane, at_line])
    return _prior_near(Directions(R, rows, poses, vectors, information, turns, observers), expected)


def _expected(map: Map, rows: I32) -> F64:
    """The poses (k, 4, 4) of keyframes once the errors of the calibration that the last alignment found are undone in those that were added since."""
    before, sensitivity, _, undone, taken = map.keyframes.columns_at(rows, "T_world_camera", "sensitivity", *ALIGNMENT)
    if not map.calibration_errors.any():
        return np.asarray(before)
    total = sensitivity + taken
    xi = matmul(total - _with_the_first(before, total), map.calibration_errors) - undone
    return np.asarray(matmul(before, np.array([exp_se3(x) for x in xi])))


def _with_the_first(poses: F64, sensitivities: F64) -> F64:
    """The part (k, 6, 12) of the sensitivities of keyframes at poses (k, 4, 4) that moves them with the first, which is not corrected."""
    return np.asarray(matmul(adjoint_between(poses, poses[:1]), sensitivities[0]))


def _moved_with(planes: F64, motions: F64) -> F64:
    """Planes (n, 4) that are moved each by a motion (n, 4, 4) of the world."""
    normals = matmul(motions[:, :3, :3], planes[:, :3, None])[..., 0]
    return np.column_stack([normals, planes[:, 3] - np.einsum("ni,ni->n", normals, motions[:, :3, 3])])


def _prior_near(directions: Directions, expected: F64) -> ManhattanPrior:
    """The prior by those directions that are near an axis once the keyframes are at the `expected` poses (k, 4, 4), and turn with them."""
    turned = matmul(expected[:, :3, :3], np.swapaxes(directions.poses[:, :3, :3], 1, 2))
    with_keyframe = turned[directions.observers]
    vectors = matmul(with_keyframe, directions.vectors[..., None])[..., 0]
    information = matmul(with_keyframe, directions.information, np.swapaxes(with_keyframe, 1, 2))
    phi, information, sensitivity = keyframe_rotations(
        vectors, information, directions.turns, directions.observers, directions.R_world_manhattan, expected, np.cos(REACH), GATE
    )
    R = matmul(np.swapaxes(directions.poses[:, :3, :3], 1, 2), expected[:, :3, :3], np.array([exp_so3(x) for x in phi]))
    return ManhattanPrior(directions, log_so3_each(R), information, sensitivity)


def _middle_observers(landmarks: Table, keyframes: I32) -> tuple[I32, I32]:
    """Living landmarks that the keyframes (sorted) observed, and the index of the middle observer of each."""
    ids = np.flatnonzero(landmarks.column("alive")).astype(np.int32)
    observers = np.sort(landmarks.rows("observers", ids), axis=1)
    count = (observers >= 0).sum(axis=1)
    middle = observers[np.arange(len(ids)), np.minimum(observers.shape[1] - count + count // 2, observers.shape[1] - 1)]
    place = index_of(middle, keyframes)
    return ids[place >= 0], place[place >= 0]


def estimate_axes(planes: F64, covariance: F64, views: I32) -> F64 | None:
    """R_world_manhattan on most views of the walls (n, 4), or None."""
    most = np.argsort(-views, kind="stable")[:WALLS]
    walls: Walls = known_walls(planes[most], covariance[most], views[most], WALL_SIGMA)
    found, R = perpendicular_pair(walls, MAX_COS, LARGEST_COS, REACH, np.eye(3), 1.0)
    if not found:
        return None
    on_axes = area_on_axes(walls, R, REACH)
    if np.count_nonzero(on_axes) < 2 or on_axes.sum() < EXPLAINED * walls.area.sum():
        return None
    on_walls: F64 = refine_rotation(walls, R, REACH, GATE, 0.0, 3)[0]
    return on_walls


# Corrections.


class CorrectionOptions(DriftOptions, Protocol):
    """Options of every correction of a map by a pose graph."""

    @property
    def shared(self) -> int:
        """Points and lines that keyframes of two visits of a place share, from which on they are connected."""


class StraighteningOptions(CorrectionOptions, Protocol):
    """Options of the alignment with the Manhattan frame."""

    @property
    def straighten_deg(self) -> float:
        """Least rotation of the newest keyframe for which the map is corrected."""


def correct_loop(
    options: CorrectionOptions, map: Map, keyframe: int, found: PoseSolution, found_error: F64, prior: ManhattanPrior | None
) -> Correction:
    """Correct the tracked sub-map by a verified loop: the newest keyframe's pose, with its covariance and its error by the calibration (6, 12),
    relative to `keyframe`.

    The loop errs by what is not known of the calibration; what the last alignment found of it is undone. The sensitivities become those of the
    corrected poses; their covariance stays, although most drift is undone. Keyframes as they would be without any alignment are corrected by the loop
    alone, as it was measured."""
    rows = keyframes_of(map, current_submap(map))
    before, sensitivity, moved, undone, taken = map.keyframes.columns_at(rows, "T_world_camera", "sensitivity", *ALIGNMENT)
    place, newest = np.searchsorted(rows, [keyframe, len(map.keyframes) - 1])
    covariance = found.covariance + sensitivity_covariance(found_error, map.calibration_information, map.calibration_score)
    measured, undo = matmul(invert(before[place]), found.T_world_camera), matmul(found_error, map.calibration_errors)
    pair, information = np.array([[place, newest]], np.int32), np.asarray(inv(covariance), np.float64)[None]
    present = present_edges(options, map, rows, connected_keyframes(options, map, rows))
    corrected = Loop(Edges(pair, matmul(measured, exp_se3(undo))[None], information), found_error[None])
    solved = _solve_with_prior(before, sensitivity, present, corrected, prior)
    unaligned = np.concatenate([sensitivity + taken, moved[..., None], undone[..., None]], axis=2)
    as_measured = Loop(Edges(pair, measured[None], information), np.column_stack([found_error, np.zeros(6), undo])[None])
    looped = _solve_with_prior(before, unaligned, present, as_measured, None)
    errors, moved, undone = looped.sensitivity[..., :CALIBRATION], looped.sensitivity[..., CALIBRATION], looped.sensitivity[..., -1]
    return replace(
        correct_keyframes(map, rows, before, solved.poses),
        sensitivity=solved.sensitivity,
        aligned=moved + _motions(looped.poses, solved.poses),
        undone=undone,
        undone_sensitivity=errors - solved.sensitivity,
        calibration_errors=map.calibration_errors,
    )


def align_with_manhattan(options: StraighteningOptions, map: Map, camera: Camera) -> Correction | None:
    """Rotate every keyframe back to the Manhattan frame of the map; None without one, or where the newest would hardly rotate.

    What the calibration explains is undone first (`calibration_turn`). The rest is drift, and is left alone where some keyframe would turn by more
    than is plausible for drift. Further passes count while they are plausible."""
    prior = estimate_manhattan_prior(map, camera)
    if prior is None:
        return None
    keyframes, before = prior.directions.keyframes, prior.directions.poses
    pairs = connected_keyframes(options, map, keyframes)
    unaligned = _unaligned(options, map, keyframes, pairs)
    aligned = _align(options, map, prior, pairs, unaligned)
    plausible = _plausible(options, aligned)
    for _ in range(PASSES - 1 if plausible else 0):
        further = _align(options, map, _prior_near(prior.directions, aligned.solved.poses), pairs, unaligned)
        if not _plausible(options, further):
            break
        aligned = further
    solved = aligned.solved if plausible else aligned.undone
    if _angles(before, solved.poses)[-1] < np.radians(options.straighten_deg):
        return None
    sensitivity = unaligned.common + matmul(solved.sensitivity, aligned.calibration.spread)
    return replace(
        correct_keyframes(map, keyframes, before, solved.poses),
        sensitivity=sensitivity,
        aligned=_motions(unaligned.poses, solved.poses),
        undone=matmul(unaligned.errors, aligned.calibration.parameters),
        undone_sensitivity=unaligned.common + unaligned.errors - sensitivity,
        calibration_errors=aligned.calibration.parameters,
    )


@dataclass(frozen=True)
class Loop:
    """Edges that close loops, and the errors (e, 6, m) of what they measure by m parameters."""

    edges: Edges
    errors: F64


@dataclass(frozen=True)
class Solved:
    """Poses (k, 4, 4) of keyframes by a pose graph, and their sensitivity (k, 6, 12) to the calibration."""

    poses: F64
    sensitivity: F64


@dataclass(frozen=True)
class Unaligned:
    """Keyframes as they would be without any alignment, and their sensitivities: that of a `common` motion with the first of them, and the rest."""

    poses: F64  # (k, 4, 4)
    errors: F64  # (k, 6, 12)
    common: F64  # (k, 6, 12)
    chain: Edges  # between keyframes that follow each other


def _unaligned(options: StraighteningOptions, map: Map, keyframes: I32, pairs: I32) -> Unaligned:
    """Return keyframes, of which `pairs` (e, 2) are connected, as they would be without any alignment. Pairs of different visits are left out: it was
    in their corrected poses that they agreed."""
    before, sensitivity, moved, _, taken = map.keyframes.columns_at(keyframes, "T_world_camera", "sensitivity", *ALIGNMENT)
    common = _with_the_first(before, sensitivity + taken)
    poses = matmul(before, np.array([exp_se3(-xi) for xi in moved]))
    chain = present_edges(options, _moved(map, keyframes, poses), keyframes, pairs[pairs[:, 1] - pairs[:, 0] <= LINKS])
    return Unaligned(poses, sensitivity + taken - common, common, chain)


@dataclass(frozen=True)
class Aligned:
    """Keyframes that are aligned with the Manhattan frame: once the errors by the calibration are undone, and as the pose graph makes them. Their
    sensitivities are to what is not known of the calibration."""

    calibration: CalibrationEstimate
    undone: Solved
    solved: Solved


def _align(options: StraighteningOptions, map: Map, prior: ManhattanPrior, pairs: I32, unaligned: Unaligned) -> Aligned:
    """Align the keyframes of the prior, of which `pairs` (e, 2) are connected, with the Manhattan frame, see `align_with_manhattan`.

    The calibration is estimated by the `unaligned` keyframes: alignments before left little of its errors. What they undid is not undone again."""
    keyframes, before, errors = prior.directions.keyframes, prior.directions.poses, unaligned.errors
    sensitivity, undone = map.keyframes.columns_at(keyframes, "sensitivity", "undone")
    directions = errors[:, 3:] + prior.sensitivity - sensitivity[:, 3:]
    calibration = _estimate_calibration(map, prior, unaligned, directions)
    xi = matmul(errors, calibration.parameters) - undone
    corrected = matmul(before, np.array([exp_se3(x) for x in xi]))
    rotations = prior.rotations + undone[:, 3:] - matmul(directions, calibration.parameters)
    rest = replace(prior, rotations=rotations, sensitivity=directions)
    present = present_edges(options, _moved(map, keyframes, corrected), keyframes, pairs)
    return Aligned(calibration, Solved(corrected, errors), _solve_with_prior(corrected, errors, present, None, rest))


def _estimate_calibration(map: Map, prior: ManhattanPrior, unaligned: Unaligned, directions: F64) -> CalibrationEstimate:
    """Estimate the calibration by directions, whose derivatives by it are `directions` (k, 3, 12), of unaligned keyframes."""
    axes = pose_matrix(prior.directions.R_world_manhattan, np.zeros(3))[None]
    edges = concatenate_edges(unaligned.chain, _directions(np.concatenate([prior.directions.poses, axes]), prior))
    differences = np.zeros((len(edges.pairs), 6, CALIBRATION))
    differences[len(unaligned.chain.pairs) :, 3:] = directions
    nodes = np.concatenate([unaligned.poses, axes])
    return estimate_calibration(nodes, edges, differences, len(unaligned.poses), map.calibration_information, -map.calibration_score)


def _moved(map: Map, keyframes: I32, poses: F64) -> Map:
    """The map with its keyframes at other poses (k, 4, 4)."""
    return replace(map, keyframes=map.keyframes.updated(keyframes, T_world_camera=poses))


def _plausible(options: StraighteningOptions, aligned: Aligned) -> bool:
    """Return True if no keyframe turns by more than drift along the whole path would turn it, once the calibration is undone."""
    undone = aligned.undone.poses
    path_m = np.linalg.norm(np.diff(undone[:, :3, 3], axis=0), axis=1).sum()
    return bool(_angles(undone, aligned.solved.poses).max() <= PLAUSIBLE * np.radians(options.rotation_drift_deg) * np.sqrt(path_m))


def _motions(before: F64, after: F64) -> F64:
    """Return xi (k, 6) of `before · Exp(xi) = after`, poses (k, 4, 4)."""
    return np.array([log_se3(T) for T in matmul(invert(before), after)])


def _angles(before: F64, after: F64) -> F64:
    """Return the angles (k,), in rad, between poses (k, 4, 4)."""
    cosine = 0.5 * (np.einsum("kij,kij->k", before[:, :3, :3], after[:, :3, :3]) - 1.0)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _solve_with_prior(before: F64, sensitivity: F64, present: Edges, closing: Loop | None, prior: ManhattanPrior | None) -> Solved:
    """Solve for the poses of keyframes by a pose graph, in which the Manhattan frame is one more node, whose direction every keyframe measures.
    Edges of the `present` poses `before` err by the calibration as these do, by their `sensitivity`; a `closing` loop as it states, and directions by
    that of the prior."""
    count, edges, differences = len(before), present, np.zeros((len(present.pairs), *sensitivity.shape[1:]))
    if closing is not None:
        edges = concatenate_edges(present, closing.edges)
        differences = np.concatenate([differences, edge_errors(before, closing.edges, sensitivity) - closing.errors])
    if prior is not None:
        axes = pose_matrix(prior.directions.R_world_manhattan, np.zeros(3))
        before, sensitivity = np.concatenate([before, axes[None]]), np.concatenate([sensitivity, np.zeros_like(sensitivity[:1])])
        edges = concatenate_edges(edges, _directions(before, prior))
        differences = np.concatenate([differences, np.pad(prior.sensitivity, ((0, 0), (3, 0), (0, 0)))])
    solved = Solved(solve_pose_graph(before, edges), remaining_errors(before, edges, sensitivity, differences))
    return Solved(solved.poses[:count], solved.sensitivity[:count])


def _directions(nodes: F64, prior: ManhattanPrior) -> Edges:
    """Edges from the Manhattan frame, the last of the nodes (k + 1, 4, 4), to each keyframe, whose direction in it the prior measures."""
    before, axes = nodes[:-1], nodes[-1]
    count = len(before)
    measured = matmul(invert(axes), before)
    measured[:, :3, :3] = matmul(measured[:, :3, :3], np.array([exp_so3(phi) for phi in prior.rotations]))
    information = np.zeros((count, 6, 6))
    information[:, :3, :3], information[:, 3:, 3:] = UNKNOWN * np.eye(3), prior.information
    pairs = np.stack([np.full(count, count), np.arange(count)], axis=1).astype(np.int32)
    return Edges(pairs, measured, information)


def connected_keyframes(options: CorrectionOptions, map: Map, rows: I32) -> I32:
    """Return pairs (e, 2) of indices of keyframes `rows`: of neighbours in time, and of keyframes of different visits of a place, without which a
    correction would open the loops that were closed."""
    neighbours = [np.stack([np.arange(len(rows) - k), np.arange(k, len(rows))], axis=1) for k in range(1, LINKS + 1)]
    return np.concatenate([*neighbours, revisits(map, rows, options.shared, LINKS)]).astype(np.int32)


def present_edges(options: CorrectionOptions, map: Map, rows: I32, pairs: I32) -> Edges:
    """Return edges that measure the map as it is between pairs (e, 2) of its keyframes `rows`. Their covariance is that of the later keyframe's pose
    plus the drift along the path."""
    return Edges(pairs, *odometry(options, map, rows[pairs], LINKS))
