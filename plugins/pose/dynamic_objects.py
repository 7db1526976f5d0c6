"""Poses where something moves: by what is at rest alone, where all the others pull away from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.geometry import invert, log_se3
from trihedron.pipeline.core.options import PositiveFloat, PositiveShare, Share
from trihedron.pipeline.core.types import DEGRADED, F64, OK, U8, Bool, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.pose.dynamic_objects_kernels import chi2, on_planes_kernel
from trihedron.plugins.pose.map_alignment import Agreement, MapAlignment, Verdict
from trihedron.plugins.shared.linalg import constant
from trihedron.plugins.shared.pose_optimizer import PoseSolution, Terms
from trihedron.plugins.shared.pose_optimizer_kernels import Flags, LineTerms, PointTerms

FIRST_SHARE = 0.5  # of the limit that a first step must reach before the rest is solved for by itself
ALL = "all"  # nothing that is at rest says more than all matches do


@dataclass(frozen=True)
class MovingObjects:
    """When what is at rest (`at_rest`) is taken alone, and when what is left is too little to be sure which of the two moves."""

    moving_share: PositiveShare = 0.15  # by which the shares of new and of proven points that disagree may differ; beyond, something may move
    moving_gate: PositiveFloat = 2.2  # Mahalanobis distance² (lowest tenth of χ²) from the pose by verified landmarks, beyond which that is taken
    moving_sure: PositiveFloat = 13.9  # the same of the position (0.997 of χ²), beyond which it is taken although new and verified disagree alike
    moving_unproven: PositiveFloat = 9.0  # the same from the position by planes alone, beyond which those are taken while nothing can be proven
    moving_most: Share = 0.4  # of all matches that must agree, half if no more of the planes do, else the pose is degraded, known as planes say

    def solved_at_rest(self, problem: MapAlignment) -> tuple[PoseSolution, str]:
        """The solution by all matches and ''; or, where something moves and pulls the pose away, that of what is at rest, with all matches judged by
        it, and what that is. Where most disagree even so, no more is known than the planes say."""
        terms = problem.terms(problem.T_start)
        found, by = problem.solved(terms), ""
        seen = problem.agreement(found)
        for rest in at_rest(problem.map, problem.matches, problem.keypoints, problem.segments, problem.planes):
            alone = self._alone(found, seen, problem, terms, rest)
            if alone is not None:
                found, by = problem.judged(alone), rest.name
                break
        if len(found.points) >= LEAST and self._denied(problem, found, by):
            by = by or ALL
            found = replace(found, covariance=spread_about(found, problem.solved(planes_alone(problem.matches).only(terms))))
        return found, by

    def judged_at_rest(self, found: PoseSolution, problem: MapAlignment, by: str, said: Verdict) -> Verdict:
        """What is said of a pose found by what is at rest; where most of what is seen denies it, or the planes alone agree, it may be something
        else."""
        if by == PLANES or (said.status == OK and self._denied(problem, found, by)):
            seen = problem.agreement(found)
            reason = f"something moves: only {seen.agreed} of {seen.matches} matches agree" + (f" with {by}" if by != ALL else "")
            return replace(said, status=DEGRADED, reason=reason)
        return replace(said, reason=f"{said.reason}, by {by} alone") if by != ALL else said

    def _alone(self, found: PoseSolution, seen: Agreement, problem: MapAlignment, terms: Terms, rest: AtRest) -> PoseSolution | None:
        """The solution by what is at rest alone, where all the others pull the pose away from the one found, which is agreed on as `seen`."""
        far = self.moving_unproven if rest.name == PLANES else self.moving_sure
        contradicted = rest.contradicted(found.points) >= self.moving_share or (rest.name == PROVEN and seen.fewer_planes)
        if not contradicted and (1.0 - seen.agreed / max(seen.matches, 1) < self.moving_share or seen.sought[2] == 0):
            return None
        if not contradicted and position_chi2(*problem.first_step(found.T_world_camera, terms, rest.flags(terms))) < FIRST_SHARE * far:
            return None
        alone = problem.solved(rest.only(terms))
        if rest.name == ON_PLANES and problem.agreement(alone).fewer_planes:  # planes that disagree with each other say nothing
            return None
        pulled = distance2(alone, found) >= self.moving_gate if contradicted else position_distance2(alone, found) > far
        return alone if pulled and (rest.name == PLANES or not alone.unobservable.shape[1]) else None

    def _denied(self, problem: MapAlignment, found: PoseSolution, by: str) -> bool:
        """Whether most of all that is seen disagrees with a pose; if of the planes as well, the larger part is enough, by more than one standard
        deviation of such a count. One by what lies on planes is denied by most and those planes that were met before: what is flat may move too."""
        seen = problem.agreement(found)
        agreed, sought, planes, same = seen.agreed, seen.matches, seen.inliers[2], seen.sought[2]
        by_larger = 2.0 * agreed < sought - sought**0.5
        if by == ON_PLANES:
            known = proven_planes(problem.map, problem.matches)
            return by_larger and bool(2 * np.count_nonzero(found.planes[:same][known]) <= np.count_nonzero(known))
        return agreed < self.moving_most * sought or (by_larger and bool(2 * planes <= same))


# What is at rest whatever else moves: what lies on planes that the map knows, and landmarks that two keyframes measured in the same place.
#
# Somebody who walks past has many corners, near and therefore measured better than any wall, and from one frame to the next they all tell of one
# motion, which may not be the camera's: near and far agree on a wrong one, a turn with a shift. But what moves is seldom flat and large, so corners
# within walls, floors and furniture's sides are the scene's, from the first frame on. And by the next keyframe what moves is elsewhere, so few of
# the landmarks that two keyframes measured are of it. Where the others contradict these, these are right.

AGREED = 2  # keyframes that measured a landmark in the same place, with which it is proven
LEAST = 30  # points of each kind below which shares of them say nothing
ON_PLANES, PROVEN, PLANES = "what lies on planes", "what is proven", "the planes"


@dataclass(frozen=True)
class AtRest:
    """Which of a frame's matches are with what is at rest, points (n,) and lines (m,), and how it is called. Planes always are."""

    name: str
    points: Bool
    lines: Bool

    def only(self, terms: Terms) -> Terms:
        """Those of the matches' terms that are of what is at rest."""
        points, lines, planes = terms
        rows, line_rows = np.flatnonzero(self.points), np.flatnonzero(self.lines)
        return PointTerms(*(column.take(rows, 0) for column in points)), LineTerms(*(column.take(line_rows, 0) for column in lines)), planes

    def flags(self, terms: Terms) -> Flags:
        """The same as flags of all terms: the others are outliers."""
        return Flags(self.points.astype(np.uint8), self.lines.astype(np.uint8), np.ones(len(terms[2].kinds), np.uint8))

    def contradicted(self, points: U8) -> float:
        """By how much larger a share (0 … 1) of the other points than of these are outliers (flags (n,)), or the other way round; 0 where
        either are too few."""
        count, agreed = np.count_nonzero(self.points), np.count_nonzero(points)
        others, these = len(points) - count, np.count_nonzero(points[self.points])
        return float(abs((others - agreed + these) / others - (count - these) / count)) if min(others, count) >= LEAST else 0.0


def at_rest(map: Map, matches: Matches, keypoints: Keypoints, segments: Segments, planes: Planes) -> list[AtRest]:
    """What a frame's pose can be found from alone, the surest first: of points on planes and of proven landmarks where there are enough; and, while
    nothing can be proven, until a third keyframe, of the planes themselves."""
    kinds = on_planes(matches, keypoints, segments, planes), proven(map, matches)
    enough = [kind for kind in kinds if np.count_nonzero(kind.points) >= LEAST]
    return enough if len(map.keyframes) > AGREED or any(kind.name == PROVEN for kind in enough) else [*enough, planes_alone(matches)]


def planes_alone(matches: Matches) -> AtRest:
    """No point and no line."""
    return AtRest(PLANES, np.zeros(len(matches.keypoints), np.bool_), np.zeros(len(matches.segments), np.bool_))


def proven(map: Map, matches: Matches) -> AtRest:
    """Matches with landmarks that at least two keyframes agree on."""
    points, lines = (table.rows("found", pairs[:, 1]) >= AGREED for table, pairs in ((map.points, matches.keypoints), (map.lines, matches.segments)))
    return AtRest(PROVEN, points, lines)


def proven_planes(map: Map, matches: Matches) -> Bool:
    """(k,) which of the same planes at least two keyframes agree on, all while there is but one: the side of what walks past is a plane as well."""
    return np.asarray(map.planes.rows("found", matches.planes[:, 1]) >= min(AGREED, len(map.keyframes)), np.bool_)


def on_planes(matches: Matches, keypoints: Keypoints, segments: Segments, planes: Planes) -> AtRest:
    """Matches of what lies on planes that are matched as well, and not at the border of something else."""
    same, points, lines = (constant(pairs, np.int32) for pairs in (matches.planes, matches.keypoints, matches.segments))
    return AtRest(ON_PLANES, *on_planes_kernel(planes.labels, same, planes.stride, keypoints.pixels, points, segments.endpoints_px, lines))


def _between(one: PoseSolution, other: PoseSolution) -> F64:
    """xi (6,) from the first pose to the other."""
    return log_se3(invert(one.T_world_camera) @ other.T_world_camera)


def distance2(one: PoseSolution, other: PoseSolution) -> float:
    """Squared standard deviations of the first solution between it and another one, which was found from more (Hausman, Econometrica 1978,
    whose covariance is the first's less the other's: this one is on the safe side)."""
    return chi2(_between(one, other), one.covariance, 6)


def position_distance2(one: PoseSolution, other: PoseSolution) -> float:
    """The same of the positions alone, whatever the rotations: walls are not quite true, and what they say of a rotation is half a degree off."""
    return position_chi2(_between(one, other), one.covariance)


def position_chi2(xi: F64, covariance: F64) -> float:
    """Squared standard deviations of the position's part of xi."""
    return chi2(xi, covariance, 3)


def spread_about(one: PoseSolution, sure: PoseSolution) -> F64:
    """Second moment (6, 6) about the first solution of a pose of which no more is known than the other says."""
    xi = _between(one, sure)
    return sure.covariance + np.outer(xi, xi)
