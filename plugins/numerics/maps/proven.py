"""What moves, told by what stayed: landmarks that two keyframes measured in the same place are part of the scene, newer ones may be anything.

Somebody who walks past has many corners, near and therefore measured better than any wall, and from one frame to the next they all tell of one
motion, which may not be the camera's. By the next keyframe they are elsewhere, so few of the landmarks that two keyframes measured are theirs. Where
new landmarks contradict proven ones, the proven ones are right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.geometry import invert, log_se3
from trihedron.pipeline.types import F64, U8, Bool, Map, Matches
from trihedron.plugins.numerics.motion.pose_solver import PoseSolution, Terms
from trihedron.plugins.numerics.motion.pose_terms import LineTerms, PointTerms

AGREED = 2  # keyframes that measured a landmark in the same place, with which it is proven
LEAST = 30  # points of each kind below which shares of them say nothing


@dataclass(frozen=True)
class Proven:
    """Which of a frame's matches are with proven landmarks: points (n,) and lines (m,). Planes are: what moves is seldom flat and large."""

    points: Bool
    lines: Bool

    def only(self, terms: Terms) -> Terms:
        """Those of the matches' terms that are of proven landmarks."""
        points, lines, planes = terms
        return PointTerms(*(column[self.points] for column in points)), LineTerms(*(column[self.lines] for column in lines)), planes

    def contradicted(self, points: U8) -> float:
        """By how much larger a share (0 … 1) of the new points than of the proven ones are outliers (flags (n,)), or the other way round; 0 where
        either are too few."""
        new, old = points[~self.points] == 0, points[self.points] == 0
        return float(abs(new.mean() - old.mean())) if min(len(new), len(old)) >= LEAST else 0.0


def proven(map: Map, matches: Matches) -> Proven:
    """Which matches are with landmarks that at least two keyframes agree on."""
    points, lines = (table.rows("found", pairs[:, 1]) >= AGREED for table, pairs in ((map.points, matches.keypoints), (map.lines, matches.segments)))
    return Proven(points, lines)


def distance2(one: PoseSolution, other: PoseSolution) -> float:
    """Squared standard deviations of the first solution between it and another one, which was found from more (Hausman, Econometrica 1978,
    whose covariance is the first's less the other's: this one is on the safe side)."""
    xi = log_se3(invert(one.T_world_camera) @ other.T_world_camera)
    return float(xi @ np.linalg.solve(one.covariance, xi))


def position_distance2(one: PoseSolution, other: PoseSolution) -> float:
    """The same of the positions alone, whatever the rotations: walls are not quite true, and what they say of a rotation is half a degree off."""
    return position_chi2(log_se3(invert(one.T_world_camera) @ other.T_world_camera), one.covariance)


def position_chi2(xi: F64, covariance: F64) -> float:
    """Squared standard deviations of the position's part of xi."""
    return float(xi[:3] @ np.linalg.solve(covariance[:3, :3], xi[:3]))
