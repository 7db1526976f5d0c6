"""Landmarks of a part of the map found among a frame's features, around where a pose projects them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.geometry import invert, transform, transform_planes
from trihedron.pipeline.types import F32, F64, I32, U8, Bool, Camera, Frame, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.numerics.images.descriptors import match_lines, match_near
from trihedron.plugins.numerics.maps.local_window import LocalWindow
from trihedron.plugins.numerics.maps.visibility import VisiblePoints, clip_segments, visible_points
from trihedron.plugins.numerics.planes.plane_association import associate_planes


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

    radius_px: float = 4.0  # least search radius, at level 0 of the pyramid
    max_radius_px: float = 20.0
    enough: int = 20  # points; when fewer are found, or the position is only a guess, they are sought once more within wide_radius_px
    wide_radius_px: float = 60.0
    view_deg: float = 60.0  # a point is not sought when seen from a direction that differs by more (ORB-SLAM2)
    octave_scale: float = 1.2  # of the key points' pyramid
    octave_step: int = 1  # levels about the predicted one
    max_distance: int = 80  # bits between descriptors of a point (ORB-SLAM2: 50 strict, 100 loose)
    max_distance_l2: int = 250  # for descriptors compared by Euclidean distance
    ratio: float = 0.85  # best to second best
    line_angle_deg: float = 8.0
    line_offset_px: float = 10.0
    line_overlap: float = 0.3  # of the shorter of the two
    line_distance: int = 60  # bits
    line_ratio: float = 0.9
    plane_angle_deg: float = 10.0  # paper, section III-A
    plane_distance_m: float = 0.1  # paper, section III-A
    parallel_deg: float = 5.0  # planes nearer to parallel are taken as parallel, and perpendicular ones likewise
    relations: int = 3  # most parallel or perpendicular partners of an observed plane

    def __post_init__(self) -> None:
        if self.relations < 0:
            raise ValueError("relations: must be at least 0")
        if not 0.0 < self.radius_px <= self.max_radius_px <= self.wide_radius_px:
            raise ValueError("radius_px: must be positive, at most max_radius_px, and that at most wide_radius_px")
        if not 1.0 < self.octave_scale <= 2.0 or self.octave_step < 0:
            raise ValueError("octave_scale, octave_step: must be in (1, 2] and at least 0")
        for name in ("view_deg", "line_angle_deg", "plane_angle_deg", "parallel_deg"):
            if not 0.0 < getattr(self, name) <= 90.0:
                raise ValueError(f"{name}: must be in (0, 90]")

    def search(self, frame: Frame, guess: Guess, keypoints: Keypoints, segments: Segments, planes: Planes, map: Map, window: LocalWindow) -> Matches:
        """Landmarks of the window found around the guess."""
        T = guess.T_world_camera
        pairs, visible = self._points(frame.camera, guess, keypoints, map, window)
        line_pairs, visible_lines = self._lines(frame.camera, T, segments, map, window)
        same, parallel, perpendicular = self._planes(T, planes, map, window)
        return Matches(frame.index, frame.stamp_ns, map.revision, pairs, line_pairs, same, parallel, perpendicular, visible, visible_lines)

    def _radius(self, camera: Camera, z: F64, guess: Guess) -> F64:
        """Search radius (px at level 0) for points at depth z: three standard deviations of the guess."""
        moved = guess.sigma_m / np.maximum(z, 0.1)
        return np.clip(self.radius_px + 3.0 * camera.fx * np.hypot(moved, guess.sigma_rad), self.radius_px, self.max_radius_px)

    def _points(self, camera: Camera, guess: Guess, keypoints: Keypoints, map: Map, window: LocalWindow) -> tuple[I32, I32]:
        """Pairs (row, id) and the ids expected in view."""
        seen = visible_points(map.points, window.points, guess.T_world_camera, camera, self.view_deg, self.octave_scale)
        descriptors = map.points.rows("descriptor", seen.ids)
        found = np.empty(0, np.int32)
        for radius in (self._radius(camera, seen.depth_m, guess), np.full(len(seen.ids), self.wide_radius_px)):
            found = self._near(seen, descriptors, keypoints, radius)
            if guess.measured and np.count_nonzero(found >= 0) >= min(self.enough, len(seen.ids), len(keypoints.pixels)):
                break
        return _pairs(found, seen.ids), seen.ids

    def _near(self, seen: VisiblePoints, descriptors: U8, keypoints: Keypoints, radius_px: F64) -> I32:
        """The row found for each point expected in view, or -1; `radius_px` (n,) at level 0."""
        return match_near(
            seen.pixels.astype(np.float32),
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

    def _lines(self, camera: Camera, T: F64, segments: Segments, map: Map, window: LocalWindow) -> tuple[I32, I32]:
        pixels, inside = clip_segments(transform(invert(T), map.lines.rows("endpoints_m", window.lines)), camera)
        ids = window.lines[inside]
        found = match_lines(
            pixels[inside].astype(np.float32),
            map.lines.rows("descriptor", ids),
            segments.endpoints_px,
            segments.descriptors,
            self.line_angle_deg,
            self.line_offset_px,
            self.line_overlap,
            self.line_distance,
            self.line_ratio,
        )
        return _pairs(found, ids), ids

    def _planes(self, T: F64, planes: Planes, map: Map, window: LocalWindow) -> tuple[I32, I32, I32]:
        """Pairs (row, id) of the same plane, of parallel and of perpendicular ones."""
        T_camera_world = invert(T)
        known = transform_planes(T_camera_world, map.planes.rows("coefficients", window.planes))
        samples: F32 = transform(T_camera_world, map.planes.rows("samples_m", window.planes)).astype(np.float32)
        same = associate_planes(planes.coefficients, planes.samples_m, known, samples, self.plane_angle_deg, self.plane_distance_m, True)
        cosine = planes.coefficients[:, :3] @ known[:, :3].T
        other = np.ones(cosine.shape, np.bool_)
        other[same[:, 0], same[:, 1]] = False
        limit = np.radians(self.parallel_deg)
        trace = np.trace(map.planes.rows("covariance", window.planes)[:, :2, :2], axis1=1, axis2=2)
        parallel = self._best(other & (np.abs(cosine) > np.cos(limit)), trace)
        perpendicular = self._best(other & (np.abs(cosine) < np.sin(limit)), trace)
        return _named(same, window.planes), _named(parallel, window.planes), _named(perpendicular, window.planes)

    def _best(self, related: Bool, trace: F64) -> I32:
        """For each observed plane (row) the `relations` related map planes (columns) whose normals are known best."""
        order = np.argsort(trace, kind="stable")
        ranked = related[:, order]
        rows, columns = np.nonzero(ranked & (np.cumsum(ranked, axis=1) <= self.relations))
        return np.stack([rows, order[columns]], axis=-1).astype(np.int32)


def _pairs(found: I32, ids: I32) -> I32:
    """Row found for each landmark (-1 = none) -> (n, 2) pairs (row, id) sorted by row."""
    hit = np.flatnonzero(found >= 0)
    pairs = np.stack([found[hit], ids[hit]], axis=-1).astype(np.int32)
    return pairs[np.argsort(pairs[:, 0], kind="stable")]


def _named(pairs: I32, ids: I32) -> I32:
    return np.stack([pairs[:, 0], ids[pairs[:, 1]]], axis=-1).astype(np.int32)
