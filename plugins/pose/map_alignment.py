"""Alignment of a frame with the map: its pose as a least-squares problem, and the inliers of a solution."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.types import F32, F64, I32, Camera, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.mapping.projection import line_terms, plane_terms, point_terms
from trihedron.plugins.pose.map_alignment_kernels import number_keyframes, observed_surfaces
from trihedron.plugins.shared.calibration_error_kernels import Observers
from trihedron.plugins.shared.pose_optimizer import (
    LANDMARK_SCORE,
    PoseSolution,
    Terms,
    classify_terms,
    first_step,
    solve_pose,
)
from trihedron.plugins.shared.pose_optimizer_kernels import Flags, Groups
from trihedron.plugins.shared.residuals_kernels import LineTerms, PlaneTerms, PointTerms


@dataclass(frozen=True)
class TrackingStatus:
    """Status of a pose (ok | degraded | lost), and its reason."""

    status: str
    reason: str


@dataclass(frozen=True)
class InlierStatistics:
    """Points, lines and planes that agree with a pose (`inliers`), of those matched; relations between planes are not counted."""

    inliers: tuple[int, int, int]
    matched: tuple[int, int, int]

    @property
    def total(self) -> int:
        """Inliers of any kind."""
        return sum(self.inliers)

    @property
    def matches(self) -> int:
        """Matches of any kind."""
        return sum(self.matched)

    @property
    def score(self) -> int:
        """Inliers weighted by kind: points + 2 lines + 5 planes."""
        return sum(count * score for count, score in zip(self.inliers, LANDMARK_SCORE))

    @property
    def image_score(self) -> int:
        """`score` without planes, which depth alone measures: points + 2 lines."""
        return sum(count * score for count, score in zip(self.inliers[:2], LANDMARK_SCORE))

    @property
    def most_planes_disagree(self) -> bool:
        """True if less than half of the planes are inliers."""
        return 2 * self.inliers[2] < self.matched[2]


class AlignmentNoise(Protocol):
    """Options of the measurements that have no covariance of their own."""

    @property
    def line_sigma_px(self) -> float:
        """Standard deviation of a segment's end point across it."""

    @property
    def relation_sigma_deg(self) -> float:
        """Standard deviation of walls that are parallel or perpendicular."""


@dataclass(frozen=True)
class MapAlignment:
    """The matches of a frame with the map, and the decoupled pose (4, 4) with its information (6, 6) as the prior."""

    options: AlignmentNoise
    T_start: F64
    information: F64
    camera: Camera
    matches: Matches
    keypoints: Keypoints
    segments: Segments
    planes: Planes
    map: Map
    made: dict[bytes, LineTerms] = field(default_factory=dict)  # pose -> terms of lines

    def terms(self, T_world_camera: F64) -> Terms:
        """All matches as terms; the extent of lines is that seen from a pose. Those of one pose are made once."""
        key, (points, planes) = T_world_camera.tobytes(), self._points_and_planes
        if key not in self.made:
            line_sigma_px = math.hypot(self.options.line_sigma_px, self.keypoints.blur_px)
            self.made[key] = line_terms(self.map, self.segments, self.matches.segments, T_world_camera, self.camera, line_sigma_px)
        return points, self.made[key], planes

    @cached_property
    def _points_and_planes(self) -> tuple[PointTerms, PlaneTerms]:
        map, matches, sigma_deg = self.map, self.matches, self.options.relation_sigma_deg
        points = point_terms(map, self.keypoints, matches.keypoints)
        return points, plane_terms(map, self.planes, matches.planes, matches.parallel, matches.perpendicular, sigma_deg)

    def solve(self, terms: Terms) -> PoseSolution:
        """Estimate the pose from these terms and the prior."""
        return solve_pose(self.T_start, self.camera, self.T_start, self.information, *terms)

    def first_step(self, T_world_camera: F64, terms: Terms, flags: Flags) -> tuple[F64, F64]:
        """Take the first Gauss–Newton step from a pose by the terms that are not outliers and the prior: xi (6,) and its covariance (6, 6)."""
        return first_step(T_world_camera, self.camera, self.T_start, self.information, terms, flags)

    def classify(self, solution: PoseSolution) -> PoseSolution:
        """Replace the flags of a solution by those of all matches, whatever it was estimated from."""
        T = solution.T_world_camera
        points, lines, planes = classify_terms(T, self.camera, *self.terms(T))
        return replace(solution, points=points, lines=lines, planes=planes)

    def statistics(self, solution: PoseSolution) -> InlierStatistics:
        """Count the inliers of a solution with the flags of all matches."""
        same = len(self.matches.planes)
        flags = solution.points, solution.lines, solution.planes[:same]
        points, lines, planes = (int(np.count_nonzero(kind)) for kind in flags)
        return InlierStatistics((points, lines, planes), (len(self.matches.keypoints), len(self.matches.segments), same))

    def plane_ids(self) -> I32:
        """Ids of the map's planes in the terms of planes: the same, the parallel and the perpendicular ones."""
        matches = self.matches
        return np.concatenate([pairs[:, 1] for pairs in (matches.planes, matches.parallel, matches.perpendicular)])

    @cached_property
    def keyframes(self) -> tuple[I32, Groups, Observers]:
        """The keyframes (k,) that created or observed the matched landmarks; which of them created each, and which observed each of the points, lines
        and identical planes."""
        map, matches = self.map, self.matches
        first, observers = map.points.columns_at(matches.keypoints[:, 1], "first", "observers")
        created = Groups(first, map.lines.rows("first", matches.segments[:, 1]), map.planes.rows("first", self.plane_ids()))
        of_lines, of_planes = (table.rows("observers", ids[:, 1]) for table, ids in ((map.lines, matches.segments), (map.planes, matches.planes)))
        observed = Observers(observers, of_lines, of_planes)
        return number_keyframes(len(map.keyframes), created, observed), created, observed

    def surfaces_at(self, pixels: F32 | F64) -> F64:
        """The observed planes (n, 4) at pixels (n, 2); NaN for none."""
        planes = self.planes
        return observed_surfaces(planes.labels, planes.stride, planes.coefficients, constant(pixels, np.float64))

    def landmarks(self, solution: PoseSolution) -> tuple[I32, I32, I32]:
        """Ids of the points, lines and planes that agree with a solution."""
        points, lines, planes = self.matches.keypoints, self.matches.segments, self.matches.planes
        return points[:, 1][solution.points > 0], lines[:, 1][solution.lines > 0], planes[:, 1][solution.planes[: len(planes)] > 0]
