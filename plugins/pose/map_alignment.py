"""A frame to be aligned with the map: its pose as a least-squares problem, and how much of what was sought agrees with a solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64, I32, Camera, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.mapping.reprojection import line_terms, plane_terms, point_terms
from trihedron.plugins.shared.pose_optimizer import PoseSolution, Terms, classify_terms, first_step, solve_pose
from trihedron.plugins.shared.pose_optimizer_kernels import Flags

SCORE = 1, 2, 5  # what a point, a line and a plane count


@dataclass(frozen=True)
class Agreement:
    """How many points, lines and planes were sought in a frame, relations between planes not counted, and how many agree with a pose."""

    inliers: tuple[int, int, int]
    sought: tuple[int, int, int]

    @property
    def agreed(self) -> int:
        """Matches that agree, of any kind."""
        return sum(self.inliers)

    @property
    def matches(self) -> int:
        """All of them."""
        return sum(self.sought)

    @property
    def score(self) -> int:
        """Matches that agree, by what each is worth."""
        return sum(count * score for count, score in zip(self.inliers, SCORE))

    @property
    def fewer_planes(self) -> bool:
        """Whether less than half of the planes agree."""
        return 2 * self.inliers[2] < self.sought[2]


@dataclass(frozen=True)
class MapAlignment:
    """The matches of a frame with the map, and the decoupled pose (4, 4) with its information (6, 6) as the prior."""

    T_start: F64
    information: F64
    camera: Camera
    matches: Matches
    keypoints: Keypoints
    segments: Segments
    planes: Planes
    map: Map
    line_sigma_px: float
    relation_sigma_deg: float

    def terms(self, T_world_camera: F64) -> Terms:
        """All matches as terms, lines taken as they are seen from a pose."""
        map, matches = self.map, self.matches
        return (
            point_terms(map, self.keypoints, matches.keypoints),
            line_terms(map, self.segments, matches.segments, T_world_camera, self.camera, self.line_sigma_px),
            plane_terms(map, self.planes, matches.planes, matches.parallel, matches.perpendicular, self.relation_sigma_deg),
        )

    def solved(self, terms: Terms) -> PoseSolution:
        """The pose by these terms and the prior."""
        return solve_pose(self.T_start, self.camera, self.T_start, self.information, *terms)

    def first_step(self, T_world_camera: F64, terms: Terms, flags: Flags) -> tuple[F64, F64]:
        """Where these terms, without outliers, and the prior would move a pose at first, xi (6,), with its covariance (6, 6)."""
        return first_step(T_world_camera, self.camera, self.T_start, self.information, terms, flags)

    def judged(self, found: PoseSolution) -> PoseSolution:
        """The solution with the flags of all matches, whatever it was found from."""
        T = found.T_world_camera
        flags = classify_terms(T, self.camera, *self.terms(T))
        return PoseSolution(T, found.covariance, found.unobservable, *flags, found.cost)

    def agreement(self, found: PoseSolution) -> Agreement:
        """Of a solution with the flags of all matches."""
        same = len(self.matches.planes)
        inliers = int(np.count_nonzero(found.points)), int(np.count_nonzero(found.lines)), int(np.count_nonzero(found.planes[:same]))
        return Agreement(inliers, (len(self.matches.keypoints), len(self.matches.segments), same))

    def landmarks(self, found: PoseSolution) -> tuple[I32, I32, I32]:
        """Ids of the points, lines and planes that agree with a solution."""
        points, lines, planes = self.matches.keypoints, self.matches.segments, self.matches.planes
        return points[:, 1][found.points > 0], lines[:, 1][found.lines > 0], planes[:, 1][found.planes[: len(planes)] > 0]


@dataclass(frozen=True)
class Verdict:
    """What is said of a pose: its status, why, and its covariance (6, 6)."""

    status: str
    reason: str
    covariance: F64
