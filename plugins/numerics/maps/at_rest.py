"""What is at rest whatever else moves: what lies on planes that the map knows, and landmarks that two keyframes measured in the same place.

Somebody who walks past has many corners, near and therefore measured better than any wall, and from one frame to the next they all tell of one
motion, which may not be the camera's: near and far agree on a wrong one, a turn with a shift. But what moves is seldom flat and large, so corners
within walls, floors and furniture's sides are the scene's, from the first frame on. And by the next keyframe what moves is elsewhere, so few of
the landmarks that two keyframes measured are of it. Where the others contradict these, these are right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.core.geometry import invert, log_se3
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.numerics.algebra.constant_arrays import constant
from trihedron.plugins.numerics.algebra.small_linear import solve_positive
from trihedron.plugins.numerics.motion.pose_kernel import Flags
from trihedron.plugins.numerics.motion.pose_solver import PoseSolution, Terms
from trihedron.plugins.numerics.motion.pose_terms import LineTerms, PointTerms

AGREED = 2  # keyframes that measured a landmark in the same place, with which it is proven
LEAST = 30  # points of each kind below which shares of them say nothing
ALONG = np.array([0.1, 0.3, 0.5, 0.7, 0.9], np.float32)  # where it is asked on what a segment lies
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
    return AtRest(ON_PLANES, *_on_planes(planes.labels, same, planes.stride, keypoints.pixels, points, segments.endpoints_px, lines))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _on_planes(labels: U8, planes: I32, stride: int, pixels: F32, points: I32, ends: F32, lines: I32) -> tuple[Bool, Bool]:
    """Which of the matched points (n, 2) and lines (m, 2), some of those at pixels (·, 2) and ends (·, 2, 2), lie within matched planes (p, 2)."""
    known, flat, straight = np.zeros(256, np.bool_), np.zeros(len(points), np.bool_), np.ones(len(lines), np.bool_)
    for i in range(len(planes)):
        known[planes[i, 0] + 1] = True
    for i in range(len(points)):
        flat[i] = _inside(labels, known, stride, pixels[points[i, 0], 0], pixels[points[i, 0], 1])
    for i in range(len(lines)):
        row = lines[i, 0]
        for share in ALONG:
            rest = np.float32(1.0) - share
            x, y = rest * ends[row, 0, 0] + share * ends[row, 1, 0], rest * ends[row, 0, 1] + share * ends[row, 1, 1]
            straight[i] = straight[i] and _inside(labels, known, stride, x, y)
    return flat, straight


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inside(labels: U8, known: Bool, stride: int, u: float, v: float) -> bool:
    """Whether all nine cells about a pixel have labels that are `known` (256,)."""
    h, w = labels.shape
    x, y = round(u / stride), round(v / stride)
    for i in range(y - 1, y + 2):
        for j in range(x - 1, x + 2):
            if not known[labels[min(max(i, 0), h - 1), min(max(j, 0), w - 1)]]:
                return False
    return True


def _between(one: PoseSolution, other: PoseSolution) -> F64:
    """xi (6,) from the first pose to the other."""
    return log_se3(invert(one.T_world_camera) @ other.T_world_camera)


def distance2(one: PoseSolution, other: PoseSolution) -> float:
    """Squared standard deviations of the first solution between it and another one, which was found from more (Hausman, Econometrica 1978,
    whose covariance is the first's less the other's: this one is on the safe side)."""
    return _chi2(_between(one, other), one.covariance, 6)


def position_distance2(one: PoseSolution, other: PoseSolution) -> float:
    """The same of the positions alone, whatever the rotations: walls are not quite true, and what they say of a rotation is half a degree off."""
    return position_chi2(_between(one, other), one.covariance)


def position_chi2(xi: F64, covariance: F64) -> float:
    """Squared standard deviations of the position's part of xi."""
    return _chi2(xi, covariance, 3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _chi2(xi: F64, covariance: F64, count: int) -> float:
    """Squared standard deviations of the first numbers of xi."""
    S, x, total = np.empty((count, count)), np.empty(count), 0.0
    for i in range(count):
        for j in range(count):
            S[i, j] = covariance[i, j]
    solve_positive(S, xi[:count], x)
    for i in range(count):
        total += xi[i] * x[i]
    return total


def spread_about(one: PoseSolution, sure: PoseSolution) -> F64:
    """Second moment (6, 6) about the first solution of a pose of which no more is known than the other says."""
    xi = _between(one, sure)
    return sure.covariance + np.outer(xi, xi)
