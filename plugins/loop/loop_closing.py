"""Loop closing by verified candidates: keyframes within the expected drift, geometric verification, and the correction that follows.

The plugins differ in how they rank candidates; `close_loop` does the rest, and aligns the map with its Manhattan frame from time to time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import log_se3
from trihedron.pipeline.core.linalg import inv, matmul, solve
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt, Range, Share
from trihedron.pipeline.core.types import F64, I32, Correction, Frame, Map, Matches
from trihedron.plugins.loop.initial_alignment import initial_pose
from trihedron.plugins.loop.manhattan_prior import align_with_manhattan, correct_loop, estimate_manhattan_prior
from trihedron.plugins.loop.registration_error import registration_error
from trihedron.plugins.loop.storeys import on_storey_of_last
from trihedron.plugins.mapping.covisibility_graph import LocalWindow, current_submap, keyframes_of, observed_by
from trihedron.plugins.mapping.data_association import PredictedPose, SearchOptions, search_map
from trihedron.plugins.mapping.keyframe_features import features_of
from trihedron.plugins.mapping.landmark_kinds import KINDS, LINE, PLANE, POINT
from trihedron.plugins.places.verification import free_space_violation, solve_pose_in_map, terms_in_map
from trihedron.plugins.shared.pose_optimizer import LANDMARK_SCORE, PoseSolution

CHI2_6 = 22.46  # 99.9 % of six degrees of freedom
SEARCH = SearchOptions(octave_step=3, relations=0)
Candidates = Iterable[tuple[int, float]]  # keyframes, the likeliest first, and the length of the path since


@dataclass(frozen=True)
class LoopOptions:
    """Options of loop closing, whatever ranks the candidates."""

    every: PositiveInt = 2  # keyframes between two looks
    away_m: PositiveFloat = 6.0  # walked since a place was left, before it can be come back to
    view_m: PositiveFloat = 2.0  # between keyframes that show the same, besides the drift
    view_deg: Annotated[float, Range(above=0, high=90)] = 45.0
    drift_share: PositiveFloat = 0.01  # of the way walked: standard deviation of the position, and per root metre of the pose graph
    floor_m: PositiveFloat = 0.02  # added to it
    rotation_sigma_deg: PositiveFloat = 0.3  # of a keyframe; the Manhattan frame keeps it from growing
    rotation_drift_deg: PositiveFloat = 0.05  # per root metre of the pose graph
    straighten: NonNegativeInt = 16  # keyframes between two alignments of the map with its Manhattan frame, doubled when the map doubles; 0 = never
    straighten_deg: PositiveFloat = 0.05  # least rotation of the newest keyframe that is worth it
    candidates: PositiveInt = 5  # verified in one call, at most
    shared: PositiveInt = 30  # points and lines already shared with a place, from which on no loop is open there and keyframes are connected
    min_score: PositiveInt = 60  # points + 2 lines + 5 planes that must agree
    min_share: Share = 0.5  # of the matches that must agree
    max_through: Share = 0.15  # of the place's surfaces in view that the camera may see through


def drift_sigma_m(options: LoopOptions, path_m: float | F64) -> float | F64:
    """Return the standard deviation of the position after a path of this length."""
    return options.floor_m + options.drift_share * path_m


def close_loop(options: LoopOptions, rank: Callable[[Map], Candidates], map: Map, frame: Frame) -> Correction | None:
    """Correct the map if the newest keyframe closes a loop, or if the map has rotated out of its Manhattan frame; None otherwise."""
    keyframes, newest = map.keyframes, len(map.keyframes) - 1
    if newest < 0 or keyframes.row("index", newest) != frame.index or not keyframes.row("alive", newest):
        return None
    correction = _first_verified(options, map, frame, rank(map)) if newest % options.every == 0 else None
    if correction is not None or not options.straighten:
        return correction
    count = len(map.keyframes)
    period = options.straighten << (count // (16 * options.straighten)).bit_length()
    return None if count % period else align_with_manhattan(options, map, frame.camera)


def _first_verified(options: LoopOptions, map: Map, frame: Frame, candidates: Candidates) -> Correction | None:
    """The correction by the first candidate that is verified."""
    examined: set[int] = set()
    tried = 0
    for keyframe, path_m in candidates:
        if keyframe in examined:
            continue
        if tried == options.candidates:
            break
        tried += 1
        place = place_of(options, map, keyframe, path_m)
        examined |= set(place.window.keyframes.tolist())
        found = _verify(options, map, frame, place) if place.found < options.shared else None
        if found is not None:
            prior = estimate_manhattan_prior(map, frame.camera) if options.straighten else None
            return correct_loop(options, map, keyframe, *found, prior)
    return None


def _verify(options: LoopOptions, map: Map, frame: Frame, place: Place) -> tuple[PoseSolution, F64] | None:
    """Pose of the newest keyframe by the landmarks of a place, and its error (6, 12) by the calibration; None when the loop is not accepted."""
    newest = len(map.keyframes) - 1
    T = T_before = map.keyframes.row("T_world_camera", newest)
    sigma_m, sigma_rad = drift_sigma_m(options, place.path_m), 2.0 * np.radians(options.rotation_sigma_deg)
    expected = np.diag(np.repeat([sigma_m**2, sigma_rad**2], 3))
    window = _own_landmarks(map, newest, place.window)
    features = features_of(map, frame.camera, T_before, window)
    T = initial_pose(map, frame.camera, place.window, window, features[0], T, expected)
    information = np.asarray(inv(expected), np.float64)
    for radius_m in (0.03, 0.01):
        matches = search_map(SEARCH, frame.camera, PredictedPose(T, radius_m, 0.3 * radius_m, True), *features, map, place.window)
        found = solve_pose_in_map(T, T_before, information, map, matches, frame.camera, *features)
        T = found.T_world_camera
    if not accept_loop(options, found, matches, expected, T_before) or free_space_violation(T, frame, map, place.window) > options.max_through:
        return None
    terms = terms_in_map(T, map, matches, frame.camera, *features)
    return found, registration_error(map, frame.camera, matches, terms, found, information)


def accept_loop(options: LoopOptions, found: PoseSolution, matches: Matches, expected: F64, T_before: F64) -> bool:
    """Return True if enough agrees, all directions are observable, and the drift is plausible by its `expected` covariance (6, 6)."""
    inliers = np.count_nonzero(found.points), np.count_nonzero(found.lines), np.count_nonzero(found.planes)
    matched = len(matches.keypoints), len(matches.segments), len(matches.planes)
    xi = log_se3(matmul(invert(T_before), found.T_world_camera))
    plausible = matmul(xi, solve(expected + found.covariance, xi)) < CHI2_6
    score, most = matmul(inliers, LANDMARK_SCORE), matmul(matched, LANDMARK_SCORE)
    enough = score >= options.min_score and score >= options.min_share * most
    return bool(plausible and enough and not found.unobservable.shape[1])


# Candidates: earlier keyframes on the same storey, within reach of the drift since.


@dataclass(frozen=True)
class Place:
    """A keyframe of long ago, the window of those with about its view and the landmarks that only they observed, the length of the path since, and
    the number of points and lines of the place that the newest keyframe observed already."""

    window: LocalWindow
    path_m: float
    found: int


def path_lengths(map: Map) -> tuple[I32, F64]:
    """Return the living keyframes of the tracked sub-map and the length of the path from each to the newest, metres."""
    rows = keyframes_of(map, current_submap(map))
    positions = map.keyframes.rows("T_world_camera", rows)[:, :3, 3]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return rows, np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])


def within_reach(options: LoopOptions, map: Map, most: int) -> tuple[I32, F64]:
    """Return up to `most` keyframes of its storey that the newest one may have come back to, nearest first, and the length of the path since."""
    rows, path_m = path_lengths(map)
    poses = map.keyframes.rows("T_world_camera", rows)
    distance = np.linalg.norm(poses[:, :3, 3] - poses[-1, :3, 3], axis=1)
    cosine = matmul(poses[:, :3, 2], poses[-1, :3, 2])
    reach = options.view_m + 3.0 * drift_sigma_m(options, path_m)
    near = (path_m > options.away_m) & (distance < reach) & (cosine > np.cos(np.radians(options.view_deg)))
    chosen = np.flatnonzero(near & on_storey_of_last(map, rows, options.drift_share) if near.any() else near)
    chosen = chosen[np.argsort(distance[chosen] / options.view_m + 1.0 - cosine[chosen], kind="stable")][:most]
    return rows[chosen], path_m[chosen]


def place_of(options: LoopOptions, map: Map, keyframe: int, path_m: float) -> Place:
    """Return the place around a keyframe."""
    rows, way = path_lengths(map)
    poses = map.keyframes.rows("T_world_camera", rows)
    own = poses[np.searchsorted(rows, keyframe)]
    near = np.linalg.norm(poses[:, :3, 3] - own[:3, 3], axis=1) < options.view_m
    near &= (matmul(poses[:, :3, 2], own[:3, 2]) > np.cos(np.radians(options.view_deg))) & (way > 0.5 * options.away_m)
    recent = rows[way <= 0.5 * options.away_m]
    there = {kind: observed_by(map, rows[near], kind) for kind in KINDS}
    ids = [np.setdiff1d(there[kind], observed_by(map, recent, kind)).astype(np.int32) for kind in there]
    found = sum(int(np.isin(observed_by(map, rows[-1:], kind), there[kind]).sum()) for kind in (POINT, LINE))
    return Place(LocalWindow(rows[near], *ids), path_m, found)


def _own_landmarks(map: Map, keyframe: int, place: LocalWindow) -> LocalWindow:
    """Window of a keyframe with its landmarks that are not in the place's."""
    row = np.array([keyframe], np.int32)
    there = {POINT: place.points, LINE: place.lines, PLANE: place.planes}
    return LocalWindow(row, *(np.setdiff1d(observed_by(map, row, kind), ids).astype(np.int32) for kind, ids in there.items()))
