"""Pose estimation in dynamic scenes: by static matches alone, where all the others pull the pose away from them.

Somebody who walks past has many corners, near and therefore measured better than any wall, and from one frame to the next they agree on one motion,
which may not be the camera's. But what moves is seldom flat and large, so corners within walls, floors and furniture's sides are static, from the
first frame on. And by the next keyframe what moves is elsewhere, so few of the landmarks that two keyframes measured (multi-view verified) belong
to it. Where the other matches contradict these static ones, the static ones are right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.lie import log_se3
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveShare, Share
from trihedron.pipeline.core.types import DEGRADED, F64, OK, U8, Bool, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.pose.dynamic_objects_kernels import mahalanobis2, on_planes_kernel
from trihedron.plugins.pose.map_alignment import InlierStatistics, MapAlignment, TrackingStatus
from trihedron.plugins.shared.pose_optimizer import PoseSolution, Terms
from trihedron.plugins.shared.pose_optimizer_kernels import Flags
from trihedron.plugins.shared.residuals_kernels import LineTerms, PointTerms

VERIFIED_VIEWS = 2  # keyframes that measured a landmark in the same place, from which on it is verified
MIN_POINTS = 30  # of each kind below which their shares are not significant
FIRST_STEP_SHARE = 0.5  # of the gate that a first step must reach before the static matches are solved for


class Selection(Enum):
    """A selection of matches that a pose is estimated by. The values are for messages."""

    ON_PLANES = "matches on planes"
    VERIFIED = "verified landmarks"
    PLANES = "the planes"
    ALL = "all"


@dataclass(frozen=True)
class MovingOptions:
    """Options of a pose that is estimated although something moves."""

    moving_share: PositiveShare = 0.15  # difference between the outlier shares of new and verified points beyond which something may move
    moving_gate: PositiveFloat = 2.2  # Mahalanobis distance² (0.1 quantile of χ² with 6 dof) from the pose by static matches that then selects it
    moving_sure: PositiveFloat = 13.9  # the same of the position (0.997 quantile, 3 dof) that selects it although the outlier shares are alike
    moving_unproven: PositiveFloat = 9.0  # the same from the position by planes alone, which are selected while no landmark is verified
    moving_most: Share = 0.4  # of all matches that must be inliers, half if most planes are outliers too, else the pose is degraded to the planes' σ
    min_share: Share = 0.25  # of the matches that must be inliers, else the pose is degraded


def solve_with_static(problem: MapAlignment, options: MovingOptions) -> tuple[PoseSolution, Selection | None]:
    """Estimate the pose by all matches; or, where something moves and pulls the pose away, by static matches, with all matches classified by it.

    Also returns the selection of static matches, None for all matches. Where most matches are outliers even so (`ALL` without a selection), the
    covariance is widened to what the planes alone support."""
    terms = problem.terms(problem.T_start)
    solution, selection = problem.solve(terms), None
    inliers = problem.statistics(solution)
    for static in static_selections(problem.map, problem.matches, problem.keypoints, problem.segments, problem.planes):
        alone = _solve_alone(solution, inliers, problem, terms, static, options)
        if alone is not None:
            solution, selection = problem.classify(alone), static.selection
            break
    if len(solution.points) >= MIN_POINTS and _is_contradicted(problem, solution, selection, options):
        selection = selection or Selection.ALL
        by_planes = problem.solve(planes_alone(problem.matches).select(terms))
        solution = replace(solution, covariance=covariance_about(solution, by_planes))
    return solution, selection


def status_with_static(
    status: TrackingStatus, solution: PoseSolution, problem: MapAlignment, selection: Selection, options: MovingOptions
) -> TrackingStatus:
    """Status of a pose estimated by this selection; degraded where most matches contradict it, or only the planes support it, since these may be the
    moving ones."""
    if selection is Selection.PLANES or (status.status == OK and _is_contradicted(problem, solution, selection, options)):
        inliers = problem.statistics(solution)
        support = f" with {selection.value}" if selection is not Selection.ALL else ""
        return replace(status, status=DEGRADED, reason=f"something moves: only {inliers.total} of {inliers.matches} matches agree{support}")
    return replace(status, reason=f"{status.reason}, by {selection.value} alone") if selection is not Selection.ALL else status


def _solve_alone(
    solution: PoseSolution, inliers: InlierStatistics, problem: MapAlignment, terms: Terms, static: StaticMatches, options: MovingOptions
) -> PoseSolution | None:
    """Estimate the pose by static matches alone; None unless the other matches pull it significantly away from that."""
    by_planes = static.selection is Selection.PLANES
    far = options.moving_unproven if by_planes else options.moving_sure
    planes_disagree = static.selection is Selection.VERIFIED and inliers.most_planes_disagree
    contradicted = planes_disagree or static.outlier_difference(solution.points) >= options.moving_share
    if not contradicted and (1.0 - inliers.total / max(inliers.matches, 1) < options.moving_share or inliers.matched[2] == 0):
        return None
    if not contradicted:
        xi, covariance = problem.first_step(solution.T_world_camera, terms, static.flags(terms))
        if mahalanobis2(xi, covariance, 3) < FIRST_STEP_SHARE * far:
            return None
    alone = problem.solve(static.select(terms))
    if static.selection is Selection.ON_PLANES and problem.statistics(alone).most_planes_disagree:
        return None  # planes that contradict each other are no evidence
    if by_planes and problem.statistics(problem.classify(alone)).total < options.min_share * inliers.matches:  # nothing else supports them
        return None
    pulled = distance2(alone, solution) >= options.moving_gate if contradicted else distance2(alone, solution, 3) > far
    return alone if pulled and (by_planes or not alone.unobservable.shape[1]) else None


def _is_contradicted(problem: MapAlignment, solution: PoseSolution, selection: Selection | None, options: MovingOptions) -> bool:
    """Return True if most matches are outliers of a pose.

    If most planes are outliers too, a majority is enough, by more than one standard deviation of such a count. A pose by matches on planes is
    contradicted by a majority together with most verified planes: what is flat may move too."""
    inliers = problem.statistics(solution)
    same = inliers.matched[2]
    majority = 2.0 * inliers.total < inliers.matches - inliers.matches**0.5
    if selection is Selection.ON_PLANES:
        verified = verified_planes(problem.map, problem.matches)
        return majority and bool(2 * np.count_nonzero(solution.planes[:same][verified]) <= np.count_nonzero(verified))
    return inliers.total < options.moving_most * inliers.matches or (majority and 2 * inliers.inliers[2] <= same)


@dataclass(frozen=True)
class StaticMatches:
    """A selection of matches assumed static, as masks of points (n,) and lines (m,). Planes are always included."""

    selection: Selection
    points: Bool
    lines: Bool

    def select(self, terms: Terms) -> Terms:
        """Select the terms of the static matches."""
        points, lines, planes = terms
        rows, line_rows = np.flatnonzero(self.points), np.flatnonzero(self.lines)
        return PointTerms(*(column.take(rows, 0) for column in points)), LineTerms(*(column.take(line_rows, 0) for column in lines)), planes

    def flags(self, terms: Terms) -> Flags:
        """The selection as flags of all terms: the others are outliers."""
        return Flags(self.points.astype(np.uint8), self.lines.astype(np.uint8), np.ones(len(terms[2].kinds), np.uint8))

    def outlier_difference(self, points: U8) -> float:
        """Difference (0 … 1) between the outlier shares of the other points and of the static ones (flags (n,)); 0 where either are too few."""
        count, agreed = np.count_nonzero(self.points), np.count_nonzero(points)
        others, these = len(points) - count, np.count_nonzero(points[self.points])
        return float(abs((others - agreed + these) / others - (count - these) / count)) if min(others, count) >= MIN_POINTS else 0.0


def static_selections(map: Map, matches: Matches, keypoints: Keypoints, segments: Segments, planes: Planes) -> list[StaticMatches]:
    """Selections that can determine a frame's pose alone, the most reliable first: matches on planes and verified landmarks where there are enough;
    and, while nothing can be verified, until a third keyframe, the planes themselves."""
    kinds = matches_on_planes(matches, keypoints, segments, planes), verified_matches(map, matches)
    enough = [kind for kind in kinds if np.count_nonzero(kind.points) >= MIN_POINTS]
    verifiable = len(map.keyframes) > VERIFIED_VIEWS or any(kind.selection is Selection.VERIFIED for kind in enough)
    return enough if verifiable else [*enough, planes_alone(matches)]


def planes_alone(matches: Matches) -> StaticMatches:
    """Select no point and no line."""
    return StaticMatches(Selection.PLANES, np.zeros(len(matches.keypoints), np.bool_), np.zeros(len(matches.segments), np.bool_))


def verified_matches(map: Map, matches: Matches) -> StaticMatches:
    """Select the matches with landmarks that at least two keyframes measured in the same place."""
    pairs = (map.points, matches.keypoints), (map.lines, matches.segments)
    points, lines = (table.rows("found", matched[:, 1]) >= VERIFIED_VIEWS for table, matched in pairs)
    return StaticMatches(Selection.VERIFIED, points, lines)


def verified_planes(map: Map, matches: Matches) -> Bool:
    """Mask (k,) of the matched planes that at least two keyframes measured, all while there is one keyframe: a moving object has planes too."""
    return np.asarray(map.planes.rows("found", matches.planes[:, 1]) >= min(VERIFIED_VIEWS, len(map.keyframes)), np.bool_)


def matches_on_planes(matches: Matches, keypoints: Keypoints, segments: Segments, planes: Planes) -> StaticMatches:
    """Select the matches of features that lie within matched planes, away from their borders."""
    same, points, lines = (constant(pairs, np.int32) for pairs in (matches.planes, matches.keypoints, matches.segments))
    within = on_planes_kernel(planes.labels, same, planes.stride, keypoints.pixels, points, segments.endpoints_px, lines)
    return StaticMatches(Selection.ON_PLANES, *within)


def _difference(one: PoseSolution, other: PoseSolution) -> F64:
    """xi (6,) from the first pose to the other."""
    return log_se3(matmul(invert(one.T_world_camera), other.T_world_camera))


def distance2(one: PoseSolution, other: PoseSolution, dimension: int = 6) -> float:
    """Squared Mahalanobis distance of another pose, estimated from more matches, by the covariance of the first (Hausman, Econometrica 1978, whose
    covariance is the first's less the other's: this one is conservative).

    With `dimension` 3 that of the positions alone: walls are not exactly perpendicular, and the rotation they measure is half a degree off."""
    return mahalanobis2(_difference(one, other), one.covariance, dimension)


def covariance_about(one: PoseSolution, other: PoseSolution) -> F64:
    """Second moment (6, 6) of the other solution's distribution about the first pose."""
    xi = _difference(one, other)
    return other.covariance + np.outer(xi, xi)
