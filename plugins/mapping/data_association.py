"""Landmarks of a part of the map found among a frame's features, around where a pose projects them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, Range, check_increasing
from trihedron.pipeline.core.types import F64, I32, U8, Camera, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.mapping.covisibility_graph import LocalWindow
from trihedron.plugins.mapping.data_association_kernels import pairs_kernel, related
from trihedron.plugins.mapping.visibility import POINT_COLUMNS, VisiblePoints, clip_segments, visible_points
from trihedron.plugins.shared.descriptors import match_lines, match_near
from trihedron.plugins.shared.linalg import constant
from trihedron.plugins.shared.plane_association import associate_planes
from trihedron.plugins.shared.plane_association_kernels import moved_planes


@dataclass(frozen=True)
class Guess:
    """A pose (4, 4) to search around, its standard deviations (m, rad), and whether it was measured at all."""

    T_world_camera: F64
    sigma_m: float
    sigma_rad: float
    measured: bool


@dataclass(frozen=True)
class MapSearch:
    """How far from its projection a landmark is sought, and what makes a match."""

    radius_px: PositiveFloat = 4.0  # least search radius, at level 0 of the pyramid
    max_radius_px: PositiveFloat = 20.0
    enough: int = 20  # points; when fewer are found, or the position is only a guess, they are sought once more within wide_radius_px
    wide_radius_px: PositiveFloat = 60.0
    view_deg: Annotated[float, Range(above=0, high=90)] = 60.0  # a point is not sought when seen from a direction that differs by more (ORB-SLAM2)
    octave_scale: Annotated[float, Range(above=1, high=2)] = 1.2  # of the key points' pyramid
    octave_step: NonNegativeInt = 1  # levels about the predicted one
    max_distance: int = 80  # bits between descriptors of a point (ORB-SLAM2: 50 strict, 100 loose)
    max_distance_l2: int = 250  # for descriptors compared by Euclidean distance
    ratio: float = 0.85  # best to second best
    line_angle_deg: Annotated[float, Range(above=0, high=90)] = 8.0
    line_offset_px: float = 10.0
    line_overlap: float = 0.3  # of the shorter of the two
    line_distance: int = 60  # bits
    line_ratio: float = 0.9
    plane_angle_deg: Annotated[float, Range(above=0, high=90)] = 10.0  # paper, section III-A
    plane_distance_m: float = 0.1  # paper, section III-A
    parallel_deg: Annotated[float, Range(above=0, high=90)] = 5.0  # planes nearer to parallel are taken as parallel, and perpendicular ones likewise
    relations: NonNegativeInt = 3  # most parallel or perpendicular partners of an observed plane

    def __post_init__(self) -> None:
        check_increasing(self, "radius_px", "max_radius_px", "wide_radius_px")

    def search(
        self, camera: Camera, guess: Guess, keypoints: Keypoints, segments: Segments, planes: Planes, map: Map, window: LocalWindow
    ) -> Matches:
        """Landmarks of the window found around the guess."""
        T_camera_world = invert(guess.T_world_camera)
        pairs, visible = self._points(camera, guess, keypoints, map, window)
        line_pairs, visible_lines = self._lines(camera, T_camera_world, segments, map, window)
        same, parallel, perpendicular = self._planes(T_camera_world, planes, map, window)
        return Matches(keypoints.index, keypoints.stamp_ns, map.revision, pairs, line_pairs, same, parallel, perpendicular, visible, visible_lines)

    def _points(self, camera: Camera, guess: Guess, keypoints: Keypoints, map: Map, window: LocalWindow) -> tuple[I32, I32]:
        """Pairs (row, id) and the ids expected in view."""
        known = window.columns(map, "points", *POINT_COLUMNS, "descriptor")
        seen = visible_points(known[:-1], guess.T_world_camera, camera, self.view_deg, self.octave_scale)
        ids, descriptors = window.points[seen.rows], known[-1][seen.rows]
        moved = guess.sigma_m / np.maximum(seen.depth_m, 0.1)  # how far the guess may be off: three standard deviations of it are searched
        radius = np.minimum(self.radius_px + 3.0 * camera.fx * np.hypot(moved, guess.sigma_rad), self.max_radius_px)
        found = self._near(seen, descriptors, keypoints, radius)
        if not guess.measured or np.count_nonzero(found >= 0) < min(self.enough, len(ids), len(keypoints.pixels)):
            found = self._near(seen, descriptors, keypoints, self.wide_radius_px)
        return pairs_kernel(found, ids, len(keypoints.pixels)), ids

    def _near(self, seen: VisiblePoints, descriptors: U8, keypoints: Keypoints, radius_px: F64 | float) -> I32:
        """The row found for each point expected in view, or -1; `radius_px` at level 0."""
        return match_near(
            seen.pixels,
            descriptors,
            seen.octaves,
            keypoints.pixels,
            keypoints.descriptors,
            keypoints.octaves,
            (radius_px * self.octave_scale ** seen.octaves.astype(np.float64)).astype(np.float32),
            self.octave_step,
            self.max_distance if keypoints.metric == "hamming" else self.max_distance_l2,
            self.ratio,
            keypoints.metric,
        )

    def _lines(self, camera: Camera, T_camera_world: F64, segments: Segments, map: Map, window: LocalWindow) -> tuple[I32, I32]:
        endpoints, descriptors = window.columns(map, "lines", "endpoints_m", "descriptor")
        pixels, inside = clip_segments(endpoints, T_camera_world, camera)
        ids = window.lines[inside]
        found = match_lines(
            pixels[inside].astype(np.float32),
            descriptors[inside],
            segments.endpoints_px,
            segments.descriptors,
            self.line_angle_deg,
            self.line_offset_px,
            self.line_overlap,
            self.line_distance,
            self.line_ratio,
        )
        return pairs_kernel(found, ids, len(segments.endpoints_px)), ids

    def _planes(self, T_camera_world: F64, planes: Planes, map: Map, window: LocalWindow) -> tuple[I32, I32, I32]:
        """Pairs (row, id) of the same plane, of parallel and of perpendicular ones."""
        world, samples, covariance = window.columns(map, "planes", "coefficients", "samples_m", "covariance")
        known, samples = moved_planes(world, samples, constant(T_camera_world[:3, :3], np.float64), constant(T_camera_world[:3, 3], np.float64))
        same = associate_planes(planes.coefficients, planes.samples_m, known, samples, self.plane_angle_deg, self.plane_distance_m, True)
        order = (covariance[:, 0, 0] + covariance[:, 1, 1]).argsort(kind="stable")  # those whose normals are known best first
        limit = math.radians(self.parallel_deg)
        parallel, perpendicular = related(planes.coefficients, known, same, order, window.planes, math.cos(limit), math.sin(limit), self.relations)
        same[:, 1] = window.planes[same[:, 1]]
        return same, parallel, perpendicular
