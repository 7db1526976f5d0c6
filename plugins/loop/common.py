"""What all loop closers share: when to look, how a place is recognised for certain, and what is corrected; and directions, recognised all along."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.geometry import invert, log_se3, pose_matrix, transform, umeyama
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt, Range, Share
from trihedron.pipeline.core.types import F64, I32, Bool, Camera, Correction, Frame, Keypoints, Map, Matches
from trihedron.plugins.loop.common_pose_graph import Closure, Drift, Trueness, close, compass_of, straighten
from trihedron.plugins.mapping.covisibility_graph import LocalWindow, current_submap, keyframes_of, observed_by
from trihedron.plugins.mapping.data_association import Guess, MapSearch
from trihedron.plugins.mapping.keyframe_features import features_of
from trihedron.plugins.mapping.reprojection import line_terms, plane_terms, point_terms
from trihedron.plugins.places.verification import seen_through
from trihedron.plugins.shared.descriptors import match_near
from trihedron.plugins.shared.plane_association import associate_planes
from trihedron.plugins.shared.plane_association_kernels import overlap
from trihedron.plugins.shared.pose_optimizer import LANDMARK_SCORE, PoseSolution, solve_pose

CHI2_6 = 22.46  # 99.9 % of six degrees of freedom
NOTHING = np.empty((0, 2), np.int32)
SEARCH = MapSearch(octave_step=3, relations=0)


@dataclass(frozen=True)
class LoopClosing(ABC):
    """Options of a loop closer, and the parts it is made of."""

    every: PositiveInt = 2  # keyframes between two looks
    away_m: PositiveFloat = 6.0  # walked since a place was left, before it can be come back to
    view_m: PositiveFloat = 2.0  # between keyframes that show the same, besides the drift
    view_deg: Annotated[float, Range(above=0, high=90)] = 45.0
    drift_share: PositiveFloat = 0.01  # of the way walked: standard deviation of the position, and per root metre of the pose graph
    floor_m: PositiveFloat = 0.02  # added to it
    rotation_sigma_deg: PositiveFloat = 0.3  # of a keyframe; the Manhattan frame keeps it from growing
    rotation_drift_deg: PositiveFloat = 0.05  # per root metre of the pose graph
    straighten: NonNegativeInt = 16  # keyframes between two alignments of the whole map's directions, doubled when the map doubles; 0 = never
    straighten_deg: PositiveFloat = 0.05  # least turn of the newest keyframe that is worth it
    candidates: PositiveInt = 5  # places looked at in one call, at most
    shared: PositiveInt = 30  # points and lines already shared with a place, from which on no loop is open there
    min_score: PositiveInt = 60  # points + 2 lines + 5 planes that must agree
    min_share: Share = 0.5  # of the matches that must agree
    max_through: Share = 0.15  # of the place's surfaces in view that the camera may see through

    @property
    def reach(self) -> Reach:
        """How far a place may be from where the camera thinks it is."""
        return Reach(self.away_m, self.view_m, self.view_deg, self.drift_share, self.floor_m)

    @property
    def drift(self) -> Drift:
        """What the pose graph takes keyframes to be uncertain by."""
        return Drift(self.drift_share, np.radians(self.rotation_drift_deg))

    def __call__(self, map: Map, frame: Frame) -> Correction | None:
        """None unless the newest keyframe closes a loop, or the directions of the map say that it has turned."""
        keyframes, newest = map.keyframes, len(map.keyframes) - 1
        if newest < 0 or keyframes.row("index", newest) != frame.index or not keyframes.row("alive", newest):
            return None
        closed = self._closed(map, frame, self.ranked(map)) if newest % self.every == 0 else None
        return closed if closed is not None else self._straightened(map)

    @abstractmethod
    def ranked(self, map: Map) -> Iterable[tuple[int, float]]:
        """Keyframes whose place the newest one may have come back to, the likeliest first, with the way walked since."""

    def _straightened(self, map: Map) -> Correction | None:
        """The map turned back to its own directions, when it is time to look and they tell."""
        count = len(map.keyframes)
        if not self.straighten or count % (self.straighten << (count // (16 * self.straighten)).bit_length()):
            return None
        compass = compass_of(map, Trueness())
        return straighten(map, self.drift, compass, np.radians(self.straighten_deg)) if compass is not None else None

    def _closed(self, map: Map, frame: Frame, ranked: Iterable[tuple[int, float]]) -> Correction | None:
        """The correction of the first of the ranked keyframes whose place is recognised."""
        looked_at: set[int] = set()
        tried = 0
        for keyframe, way in ranked:
            if keyframe in looked_at:
                continue
            if tried == self.candidates:
                break
            tried += 1
            place = place_of(map, keyframe, way, self.reach)
            looked_at |= set(place.seen.keyframes.tolist())
            closure = self._recognised(map, frame, place) if place.found < self.shared else None
            if closure is not None:
                return close(map, closure, self.drift, compass_of(map, Trueness()) if self.straighten else None)
        return None

    def _recognised(self, map: Map, frame: Frame, place: Place) -> Closure | None:
        """The newest keyframe's pose by what the place's keyframes saw, or None when that is not certain."""
        newest = len(map.keyframes) - 1
        T_before = map.keyframes.row("T_world_camera", newest)
        expected = self._expected(place.walked_m)
        here = _seen_alone(map, newest, place.seen)
        features = features_of(map, frame.camera, T_before, here)
        T = self._start(map, frame, place, here, T_before)
        found, matches = None, None
        for sigma_m in (0.03, 0.01):
            matches = SEARCH.search(frame.camera, Guess(T, sigma_m, 0.3 * sigma_m, True), *features, map, place.seen)
            found = solve_pose(
                T, frame.camera, T_before, np.asarray(np.linalg.inv(expected), np.float64),
                point_terms(map, features[0], matches.keypoints),
                line_terms(map, features[1], matches.segments, T, frame.camera, 1.0),
                plane_terms(map, features[2], matches.planes, NOTHING, NOTHING, 1.0),
            )  # fmt: skip
            T = found.T_world_camera
        if found is None or matches is None or not self._certain(found, matches, expected, T_before):
            return None
        if seen_through(T, frame, map, place.seen) > self.max_through:
            return None
        return Closure(newest, place.keyframe, T, found.covariance)

    def _expected(self, walked_m: float) -> F64:
        """(6, 6) covariance of how far the newest keyframe's pose is off relative to one so many metres of way ago."""
        sigma_m, sigma_rad = self.floor_m + self.drift_share * walked_m, 2.0 * np.radians(self.rotation_sigma_deg)
        return np.diag(np.repeat([sigma_m**2, sigma_rad**2], 3))

    def _start(self, map: Map, frame: Frame, place: Place, here: LocalWindow, T: F64) -> F64:
        """Where to begin: as if there were no drift, where the planes lie on those of the place, or where points that look alike agree; the one
        of the three under which most points agree."""
        expected = self._expected(place.walked_m)
        sigma_m, sigma_rad = np.sqrt(expected[0, 0]), np.sqrt(expected[3, 3])
        keypoints = features_of(map, frame.camera, T, here)[0]
        pairs = alike(map, frame.camera, T, keypoints, place.seen.points, sigma_m, sigma_rad)
        points, there = keypoints.points_m[pairs[:, 0]].astype(np.float64), map.points.rows("position_m", pairs[:, 1])
        spread = 0.01 + keypoints.sigma_m[pairs[:, 0]].astype(np.float64) + sigma_rad * points[:, 2]
        by_planes = shift_of_planes(map, here.planes, place.seen.planes, sigma_m)[0]
        starts = [T, pose_matrix(T[:3, :3], T[:3, 3] + by_planes), shift_of_points(transform(T, points), there, spread) @ T]
        agreeing = [np.count_nonzero(np.linalg.norm(transform(start, points) - there, axis=1) < 3.0 * spread) for start in starts]
        return starts[int(np.argmax(agreeing))]

    def _certain(self, found: PoseSolution, matches: Matches, expected: F64, T_before: F64) -> bool:
        """Whether enough agrees, nothing is left open, and the drift is one that can be."""
        agreeing = np.count_nonzero(found.points), np.count_nonzero(found.lines), np.count_nonzero(found.planes)
        offered = len(matches.keypoints), len(matches.segments), len(matches.planes)
        xi = log_se3(invert(T_before) @ found.T_world_camera)
        possible = xi @ np.linalg.solve(expected + found.covariance, xi) < CHI2_6
        score, most = np.dot(agreeing, LANDMARK_SCORE), np.dot(offered, LANDMARK_SCORE)
        enough = score >= self.min_score and score >= self.min_share * most
        return bool(possible and enough and not found.unobservable.shape[1])


def _seen_alone(map: Map, keyframe: int, place: LocalWindow) -> LocalWindow:
    """What a keyframe saw that the place does not have."""
    row = np.array([keyframe], np.int32)
    ids: list[I32] = [
        np.setdiff1d(observed_by(map, row, kind), there).astype(np.int32)
        for kind, there in (("point", place.points), ("line", place.lines), ("plane", place.planes))
    ]
    return LocalWindow(row, *ids)


# Places the camera may have come back to: keyframes of long ago within reach of what it may have drifted since.


@dataclass(frozen=True)
class Reach:
    """What counts as long ago and as near, and how fast the camera's place gets uncertain: `drift_share` of the way walked (standard deviation)."""

    away_m: float  # walked since, at least
    view_m: float  # between two keyframes that see the same, besides the drift
    view_deg: float  # between their viewing directions
    drift_share: float
    floor_m: float

    def sigma_m(self, walked_m: F64) -> F64:
        """(n,) standard deviation of the position after a way (n,)."""
        return self.floor_m + self.drift_share * walked_m


@dataclass(frozen=True)
class Place:
    """A keyframe of long ago, those that saw the same from about there, the landmarks only they know, the way walked since, and how many points
    and lines of the place the newest keyframe has found already."""

    keyframe: int
    seen: LocalWindow
    walked_m: float
    found: int


def walked(map: Map) -> tuple[I32, F64]:
    """Rows of the living keyframes of the tracked sub-map and the way walked from each to the newest, metres."""
    rows = keyframes_of(map, current_submap(map))
    positions = map.keyframes.rows("T_world_camera", rows)[:, :3, 3]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    return rows, np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])


def within_reach(map: Map, reach: Reach) -> tuple[I32, F64]:
    """Keyframes that the newest one may have come back to, nearest first, and the way walked since."""
    rows, way = walked(map)
    poses = map.keyframes.rows("T_world_camera", rows)
    distance = np.linalg.norm(poses[:, :3, 3] - poses[-1, :3, 3], axis=1)
    cosine = poses[:, :3, 2] @ poses[-1, :3, 2]
    good = (way > reach.away_m) & (distance < reach.view_m + 3.0 * reach.sigma_m(way)) & (cosine > np.cos(np.radians(reach.view_deg)))
    chosen = np.flatnonzero(good)
    chosen = chosen[np.argsort(distance[chosen] / reach.view_m + 1.0 - cosine[chosen], kind="stable")]
    return rows[chosen], way[chosen]


def place_of(map: Map, keyframe: int, walked_m: float, reach: Reach) -> Place:
    """The place around a keyframe."""
    rows, way = walked(map)
    poses = map.keyframes.rows("T_world_camera", rows)
    own = poses[np.searchsorted(rows, keyframe)]
    near = np.linalg.norm(poses[:, :3, 3] - own[:3, 3], axis=1) < reach.view_m
    near &= (poses[:, :3, 2] @ own[:3, 2] > np.cos(np.radians(reach.view_deg))) & (way > 0.5 * reach.away_m)
    recent = rows[way <= 0.5 * reach.away_m]
    found, ids = 0, []
    for kind in ("point", "line", "plane"):
        there, here = observed_by(map, rows[near], kind), observed_by(map, recent, kind)
        if kind != "plane":
            found += int(np.isin(observed_by(map, rows[-1:], kind), there).sum())
        ids.append(np.setdiff1d(there, here).astype(np.int32))
    return Place(keyframe, LocalWindow(rows[near], *ids), walked_m, found)


# By how much a camera that came back has drifted: a displacement on which points that look alike, or the layout of planes, agree.
#
# The rotation does not drift, so what was seen again is shifted, and turned by so little that the refinement that follows finds it.

ALIKE_BITS, ALIKE_L2, RATIO = 60, 200, 0.85  # between descriptors of two views, and best to second best (ORB-SLAM2: 50 to 100 bits)
LAYOUT_DEG, LAYOUT_M = 10.0, 0.05  # between the directions of planes that may be one; between their offsets, displaced
SCALES_M = (0.1, 0.3, 0.9, 3.0)  # between their offsets before
EXTENT_M = 0.5  # within which a sample of one plane has one of the other where both extend
ROUNDS, FEWEST = 3, 6  # of a refinement; points


def alike(map: Map, camera: Camera, T_world_camera: F64, keypoints: Keypoints, ids: I32, sigma_m: float, sigma_rad: float) -> I32:
    """(n, 2) pairs (row of the keyframe's points, id among `ids`) that look alike within three standard deviations of where they are expected."""
    local = transform(invert(T_world_camera), map.points.rows("position_m", ids))
    ids, local = ids[local[:, 2] > 0.1], local[local[:, 2] > 0.1]
    depth = np.maximum(keypoints.points_m[:, 2].astype(np.float64), 0.5)
    radius = 3.0 * camera.fx * (sigma_m / depth + sigma_rad)
    limit = ALIKE_L2 if keypoints.metric == "l2" else ALIKE_BITS
    found = match_near(
        keypoints.pixels, keypoints.descriptors, keypoints.octaves,
        camera.project(local).astype(np.float32), map.points.rows("descriptor", ids), map.points.rows("octave", ids),
        radius.astype(np.float32), 3, limit, RATIO, keypoints.metric,
    )  # fmt: skip
    rows = np.flatnonzero(found >= 0)
    return np.stack([rows, ids[found[rows]]], axis=1).astype(np.int32)


def shift_of_points(here: F64, there: F64, sigma_m: F64) -> F64:
    """Motion T (4, 4) with `there ≈ T here` for most of the pairs of points (n, 3), each good to `sigma_m` (n,): each pair says a displacement, and
    the one most others share is refined to a motion. The identity where fewer than FEWEST agree."""
    T = np.eye(4)
    if len(here) < FEWEST:
        return T
    shift = there - here
    near = np.linalg.norm(shift[:, None] - shift[None], axis=2) < 3.0 * np.hypot(sigma_m[:, None], sigma_m[None])
    chosen = near[np.argmax(near.sum(axis=1))]
    for _ in range(ROUNDS):
        if np.count_nonzero(chosen) < FEWEST:
            return np.eye(4)
        T = umeyama(here[chosen], there[chosen])
        chosen = np.linalg.norm(there - transform(T, here), axis=1) < 3.0 * sigma_m
    return T


def shift_of_planes(map: Map, here: I32, there: I32, sigma_m: float) -> tuple[F64, float]:
    """Displacement (3,) that brings the planes `here` onto those `there`, as far as they say, and how much of their extent agrees (in planes).

    Planes of one direction are paired when their offsets differ by little, then by more, up to three standard deviations; the displacement
    under which most agrees is taken, the smaller one when two are alike."""
    planes = [map.planes.rows("coefficients", ids) for ids in (here, there)]
    samples = [map.planes.rows("samples_m", ids) for ids in (here, there)]
    best, agreed = np.zeros(3), 0.0
    for reach_m in sorted({min(reach, 3.0 * sigma_m) for reach in SCALES_M}):
        pairs = associate_planes(planes[0], samples[0], planes[1], samples[1], LAYOUT_DEG, reach_m, True)
        n, offset = planes[0][pairs[:, 0], :3], planes[0][pairs[:, 0], 3] - planes[1][pairs[:, 1], 3]
        shift, kept = _shift(n, offset, sigma_m)
        score = float(sum(overlap(samples[0][a] + shift.astype(np.float32), samples[1][b], EXTENT_M) for a, b in pairs[kept]))
        if score > 1.1 * agreed:
            best, agreed = shift, score
    return best, agreed


def _shift(n: F64, offset: F64, sigma_m: float) -> tuple[F64, Bool]:
    """Least squares of `n · shift = offset` (k, 3), (k,) with a prior, without those that contradict the rest; the shift and which were kept."""
    shift, kept = np.zeros(3), np.ones(len(n), np.bool_)
    for _ in range(len(n)):
        A = n[kept].T @ n[kept] / LAYOUT_M**2 + np.eye(3) / max(sigma_m, 1e-3) ** 2
        shift = np.asarray(np.linalg.solve(A, n[kept].T @ offset[kept] / LAYOUT_M**2), np.float64)
        error = np.where(kept, np.abs(n @ shift - offset), 0.0)
        if error.max() < LAYOUT_M:
            break
        kept[np.argmax(error)] = False
    return shift, kept
