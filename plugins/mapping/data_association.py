"""Data association: landmarks of a local window are projected at a predicted pose and matched with a frame's features nearby (section III-A)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, Range, check_increasing
from trihedron.pipeline.core.types import F64, I32, U8, Camera, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.mapping.covisibility_graph import LocalWindow
from trihedron.plugins.mapping.landmark_kernels import pairs_by_row, related_planes
from trihedron.plugins.mapping.landmark_kinds import LINE, PLANE, POINT
from trihedron.plugins.mapping.projection import POINT_COLUMNS, VisiblePoints, clip_segments, visible_points
from trihedron.plugins.shared.feature_matching import associate_planes, match_lines, match_near
from trihedron.plugins.shared.feature_matching_kernels import transform_plane_samples


@dataclass(frozen=True)
class PredictedPose:
    """A pose (4, 4) to search around, its standard deviations (m, rad), and False where it is a mere extrapolation."""

    T_world_camera: F64
    sigma_m: float
    sigma_rad: float
    measured: bool


@dataclass(frozen=True)
class SearchOptions:
    """Search radii about a landmark's projection, and thresholds of a match."""

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
    line_offset_px: float = 10.0  # of a segment beside its prediction
    line_overlap: float = 0.3  # of the shorter of the two
    line_distance: int = 60  # bits
    line_ratio: float = 0.9  # best to second best descriptor of lines
    plane_angle_deg: Annotated[float, Range(above=0, high=90)] = 10.0  # paper, section III-A
    plane_distance_m: float = 0.1  # paper, section III-A
    parallel_deg: Annotated[float, Range(above=0, high=90)] = 5.0  # planes nearer to parallel are taken as parallel, and perpendicular ones likewise
    relations: NonNegativeInt = 3  # most parallel or perpendicular partners of an observed plane

    def __post_init__(self) -> None:
        check_increasing(self, "radius_px", "max_radius_px", "wide_radius_px")


def search_map(
    options: SearchOptions, camera: Camera, prediction: PredictedPose, keypoints: Keypoints, segments: Segments, planes: Planes, map: Map,
    window: LocalWindow,
) -> Matches:  # fmt: skip
    """Match the landmarks of the window with the frame's features about the predicted pose."""
    T_camera_world = invert(prediction.T_world_camera)
    pairs, visible = _match_points(options, camera, prediction, keypoints, map, window)
    line_pairs, visible_lines = _match_lines(options, camera, T_camera_world, segments, map, window)
    same, parallel, perpendicular = _match_planes(options, T_camera_world, planes, map, window)
    return Matches(keypoints.index, keypoints.stamp_ns, map.revision, pairs, line_pairs, same, parallel, perpendicular, visible, visible_lines)


def _match_points(
    options: SearchOptions, camera: Camera, prediction: PredictedPose, keypoints: Keypoints, map: Map, window: LocalWindow
) -> tuple[I32, I32]:
    """Pairs (row, id) and the ids expected in view."""
    *position, descriptors = window.columns(map, POINT, *POINT_COLUMNS, "descriptor")
    visible = visible_points(position, prediction.T_world_camera, camera, options.view_deg, options.octave_scale)
    ids, descriptors = window.points.take(visible.rows), descriptors.take(visible.rows, 0)
    sigma = prediction.sigma_m / np.maximum(visible.depth_m, 0.1)  # of the projection, rad; three standard deviations are searched
    radius = np.minimum(options.radius_px + 3.0 * camera.fx * np.hypot(sigma, prediction.sigma_rad), options.max_radius_px)
    found = _match_visible(options, visible, descriptors, keypoints, radius)
    if not prediction.measured or np.count_nonzero(found >= 0) < min(options.enough, len(ids), len(keypoints.pixels)):
        found = _match_visible(options, visible, descriptors, keypoints, options.wide_radius_px)
    return pairs_by_row(found, ids, len(keypoints.pixels)), ids


def _match_visible(options: SearchOptions, visible: VisiblePoints, descriptors: U8, keypoints: Keypoints, radius_px: F64 | float) -> I32:
    """Row of the key point matched with each visible point, or -1; `radius_px` at level 0."""
    radius = (radius_px * options.octave_scale ** visible.octaves.astype(np.float64)).astype(np.float32)
    limit = options.max_distance if keypoints.metric == "hamming" else options.max_distance_l2
    return match_near(
        visible.pixels, descriptors, visible.octaves, keypoints.pixels, keypoints.descriptors, keypoints.octaves,
        radius, options.octave_step, limit, options.ratio, keypoints.metric,
    )  # fmt: skip


def _match_lines(options: SearchOptions, camera: Camera, T_camera_world: F64, segments: Segments, map: Map, window: LocalWindow) -> tuple[I32, I32]:
    """Pairs (row, id) and the ids expected in view."""
    endpoints, descriptors = window.columns(map, LINE, "endpoints_m", "descriptor")
    pixels, inside = clip_segments(endpoints, T_camera_world, camera)
    found = match_lines(
        pixels[inside].astype(np.float32), descriptors[inside], segments.endpoints_px, segments.descriptors,
        options.line_angle_deg, options.line_offset_px, options.line_overlap, options.line_distance, options.line_ratio,
    )  # fmt: skip
    return pairs_by_row(found, window.lines[inside], len(segments.endpoints_px)), window.lines[inside]


def _match_planes(options: SearchOptions, T_camera_world: F64, planes: Planes, map: Map, window: LocalWindow) -> tuple[I32, I32, I32]:
    """Pairs (row, id) of the same plane, of parallel and of perpendicular ones."""
    world, samples, covariance = window.columns(map, PLANE, "coefficients", "samples_m", "covariance")
    R, t = constant(T_camera_world[:3, :3], np.float64), constant(T_camera_world[:3, 3], np.float64)
    known, samples = transform_plane_samples(world, samples, R, t)
    same = associate_planes(planes.coefficients, planes.samples_m, known, samples, options.plane_angle_deg, options.plane_distance_m, True)
    order = (covariance[:, 0, 0] + covariance[:, 1, 1]).argsort(kind="stable")  # the most certain normals first
    limit = math.radians(options.parallel_deg)
    related = related_planes(planes.coefficients, known, same, order, window.planes, math.cos(limit), math.sin(limit), options.relations)
    same[:, 1] = window.planes[same[:, 1]]
    return same, *related
