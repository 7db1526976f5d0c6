"""Geometric verification of a place for relocalisation: search the map from a hypothesis, solve the pose, and test for free-space violations.

Loops are verified in `plugins/loop/loop_closing.py`, which solves and tests with these functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Camera, Frame, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.mapping.covisibility_graph import VICINITY_DEG, VICINITY_M, LocalWindow, are_distinct, local_window, window_of
from trihedron.plugins.mapping.data_association import PredictedPose, SearchOptions, search_map
from trihedron.plugins.mapping.landmark_kernels import MIN_DEPTH_M
from trihedron.plugins.mapping.projection import in_image, line_terms, plane_terms, point_terms
from trihedron.plugins.shared.pose_optimizer import LANDMARK_SCORE, PoseSolution, Terms, solve_pose

TOLERANCE_M, TOLERANCE_SIGMAS = 0.1, 5.0  # of depth, before a surface is violated
DETAILED = np.array([100, 30])  # points and lines expected in view, from which on a place is recognised by these
DETAILS = np.array([1, 3, 0])  # weights of points, lines and planes as details: any room has walls at some distance or other
WIDE, CLOSE = (0.05, 2.0), (0.005, 0.2)  # standard deviations (m, °) of a hypothesis, and of the pose solved from it
STRICT = SearchOptions(enough=0, max_distance=50, max_distance_l2=200, line_distance=40)  # ORB-SLAM2: 50; false matches often pass 80
PRIOR_M, PRIOR_DEG = 0.5, 10.0  # weak: the data decide
LINE_PX = 1.0  # of a segment's end point across it


def free_space_violation(T_world_camera: F64, frame: Frame, map: Map, window: LocalWindow) -> float:
    """Return the share of the points and plane samples in view of a camera at (4, 4) that would lie in free space: the frame's depth is beyond them.
    Occluded ones and pixels without depth do not count. 0 where nothing is in view."""
    samples = map.planes.rows("samples_m", window.planes).reshape(-1, 3).astype(np.float64)
    world = np.concatenate([map.points.rows("position_m", window.points), samples[np.isfinite(samples[:, 0])]])
    local = transform(invert(T_world_camera), world)
    local = local[local[:, 2] > MIN_DEPTH_M]
    pixels = frame.camera.project(local)
    inside = in_image(pixels, frame.camera)
    x, y = np.rint(pixels[inside]).astype(int).T
    depth, z = frame.depth_m[y, x].astype(np.float64), local[inside, 2]
    tolerance = TOLERANCE_M + TOLERANCE_SIGMAS * frame.camera.depth_noise.sigma_m(depth)
    violated = int(np.count_nonzero((depth > 0.0) & (z < depth - tolerance)))
    confirmed = int(np.count_nonzero((depth > 0.0) & (np.abs(z - depth) <= tolerance)))
    return violated / max(violated + confirmed, 1)


class FrameFeatures(NamedTuple):
    """A frame and its features."""

    frame: Frame
    keypoints: Keypoints
    segments: Segments
    planes: Planes


@dataclass(frozen=True)
class VerifiedPlace:
    """The pose (4, 4) at a place with covariance (6, 6), the inliers among points, lines and planes, their share of all matches, the share of the
    details expected in view that are inliers, the smaller of the shares of points and of lines (`least_share`), and the share of surfaces with a
    free-space violation."""

    T_world_camera: F64
    covariance: F64
    inliers: I32
    inlier_share: float
    found_share: float
    least_share: float
    violation: float

    @property
    def score(self) -> float:
        """Return the weighted number of inliers."""
        return float(matmul(self.inliers, LANDMARK_SCORE))

    @property
    def details(self) -> float:
        """Return the weighted number of inliers among points and lines."""
        return float(matmul(self.inliers, DETAILS))


def verify_place(T_world_camera: F64, view: FrameFeatures, map: Map, keyframes: I32, near: int) -> VerifiedPlace | None:
    """Search the map from a hypothesis (4, 4), widely, then closely and strictly from the pose solved; None when that moves, or is unobservable.

    The landmarks are those of the `near` keyframes in the vicinity; where there are none, those of the candidate `keyframes`, so that a similar
    place can compete. All are of the sub-map of these."""
    T, information = T_world_camera, np.diag(np.repeat([PRIOR_M**-2, np.radians(PRIOR_DEG) ** -2], 3))
    submap = int(map.keyframes.row("submap", int(keyframes[0])))
    for (sigma_m, sigma_deg), options in ((WIDE, SearchOptions(enough=0)), (CLOSE, STRICT)):
        window = local_window(map, T, 0, 0, near, VICINITY_M, VICINITY_DEG, submap)
        window = window if len(window.keyframes) else window_of(map, keyframes)
        prediction = PredictedPose(T, sigma_m, float(np.radians(sigma_deg)), True)
        matches = search_map(options, view.frame.camera, prediction, *view[1:], map, window)
        found = solve_pose_in_map(T, T, information, map, matches, view.frame.camera, *view[1:])
        if found.unobservable.shape[1]:
            return None
        before, T = T, found.T_world_camera
    if are_distinct(before, T):
        return None
    inliers = np.array([np.count_nonzero(found.points), np.count_nonzero(found.lines), np.count_nonzero(found.planes)], np.int32)
    matched = len(matches.keypoints) + len(matches.segments) + len(matches.planes)
    expected = np.array([len(matches.visible_points), len(matches.visible_lines), 0])
    inlier_share, found_share = float(inliers.sum() / max(matched, 1)), float(matmul(inliers, DETAILS) / max(matmul(expected, DETAILS), 1))
    violation = free_space_violation(T, view.frame, map, window)
    return VerifiedPlace(T, found.covariance, inliers, inlier_share, found_share, least_share(inliers, matches, view.keypoints), violation)


def least_share(inliers: I32, matches: Matches, keypoints: Keypoints) -> float:
    """Return the smaller of the shares of points and of lines expected in view that are inliers (3,). Points are expected as many as have depth, or
    as the map has there; a kind of which fewer than `DETAILED` are expected does not count.

    Lines of rooms built alike agree with a map while points do not, and points of a pattern that repeats while lines do not."""
    with_depth = int(np.count_nonzero(np.isfinite(keypoints.points_m[:, 2])))
    expected = np.array([min(with_depth, len(matches.visible_points)), len(matches.visible_lines)])
    return float((inliers[:2] / np.maximum(expected, 1))[expected >= DETAILED].min(initial=1.0))


def solve_pose_in_map(
    T: F64, T_prior: F64, information: F64, map: Map, matches: Matches, camera: Camera, keypoints: Keypoints, segments: Segments, planes: Planes
) -> PoseSolution:
    """Estimate the pose by matches with the map, without relations of planes, from T; `information` (6, 6) is that of the prior T_prior."""
    return solve_pose(T, camera, T_prior, information, *terms_in_map(T, map, matches, camera, keypoints, segments, planes))


def terms_in_map(T: F64, map: Map, matches: Matches, camera: Camera, keypoints: Keypoints, segments: Segments, planes: Planes) -> Terms:
    """Return the terms of matches with the map, without relations of planes; the extent of lines is that seen from T."""
    none = matches.parallel[:0]
    points, lines = point_terms(map, keypoints, matches.keypoints), line_terms(map, segments, matches.segments, T, camera, LINE_PX)
    return points, lines, plane_terms(map, planes, matches.planes, none, none, 1.0)
