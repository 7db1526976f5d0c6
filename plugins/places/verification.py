"""What the camera would see through, were it at a supposed place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.types import F64, I32, Frame, Keypoints, Map, Matches, Planes, Segments
from trihedron.plugins.mapping.covisibility_graph import LocalWindow, local_window, window_of
from trihedron.plugins.mapping.data_association import Guess, MapSearch
from trihedron.plugins.mapping.reprojection import line_terms, plane_terms, point_terms
from trihedron.plugins.mapping.visibility import in_image
from trihedron.plugins.mapping.visibility_kernels import NEAR_M
from trihedron.plugins.places.recognition import apart
from trihedron.plugins.shared.pose_optimizer import LANDMARK_SCORE, PoseSolution, solve_pose

TOLERANCE_M, TOLERANCE_SIGMAS = 0.1, 5.0  # of depth, before a surface is not where it should be


def seen_through(T_world_camera: F64, frame: Frame, map: Map, seen: LocalWindow) -> float:
    """Share of the known points and samples of planes in view of a camera at (4, 4) that would hang in free space: the frame's depth lies beyond
    them. What something hides says nothing, nor does a pixel without depth. 0 where nothing is in view."""
    samples = map.planes.rows("samples_m", seen.planes).reshape(-1, 3).astype(np.float64)
    world = np.concatenate([map.points.rows("position_m", seen.points), samples[np.isfinite(samples[:, 0])]])
    local = transform(invert(T_world_camera), world)
    local = local[local[:, 2] > NEAR_M]
    pixels = frame.camera.project(local)
    inside = in_image(pixels, frame.camera)
    x, y = np.rint(pixels[inside]).astype(int).T
    depth, z = frame.depth_m[y, x].astype(np.float64), local[inside, 2]
    tolerance = TOLERANCE_M + TOLERANCE_SIGMAS * frame.camera.depth_noise.sigma_m(depth)
    through = int(np.count_nonzero((depth > 0.0) & (z < depth - tolerance)))
    met = int(np.count_nonzero((depth > 0.0) & (np.abs(z - depth) <= tolerance)))
    return through / max(through + met, 1)


# How much of the map agrees that a frame was taken at a supposed place.

DETAILS = np.array([1, 3, 0])  # and as what tells one room from another: any room has walls at some distance or other
ABOUT_M, ABOUT_DEG = 2.0, 60.0  # keyframes taken from nearer than this have seen a place
WIDE, CLOSE = (0.05, 2.0), (0.005, 0.2)  # standard deviations (m, °) of a hypothesis, and of the pose solved from it
PRIOR_M, PRIOR_DEG = 0.5, 10.0  # the data decide
LINE_PX = 1.0  # of a segment's end point across it
STRICT = {"max_distance": 50, "max_distance_l2": 200, "line_distance": 40}  # of descriptors (ORB-SLAM2: 50); strangers that lie right pass 80 often


class FrameFeatures(NamedTuple):
    """A frame and what was found in it."""

    frame: Frame
    keypoints: Keypoints
    segments: Segments
    planes: Planes


@dataclass(frozen=True)
class Recognised:
    """A place after the check: the pose (4, 4) solved from what agrees, its covariance (6, 6), the points, lines and planes that agree, the share of
    all matches that these are, the share of the details expected in view that were found and agree, and of surfaces that the camera would see
    through."""

    T_world_camera: F64
    covariance: F64
    inliers: I32
    agreeing: float
    found: float
    through: float

    @property
    def score(self) -> float:
        """Of all that agrees."""
        return float(self.inliers @ LANDMARK_SCORE)

    @property
    def details(self) -> float:
        """Of the details among it."""
        return float(self.inliers @ DETAILS)


def check_place(T_world_camera: F64, view: FrameFeatures, map: Map, among: I32, near: int) -> Recognised | None:
    """Search the map from a hypothesis (4, 4), widely, then closely and for what looks very much alike from the pose solved, with what the `near`
    keyframes about it see; where there are none, with what the keyframes `among` see, since a twin of a place must be able to compete. All are of
    the sub-map of these. None when the place does not hold."""
    T = T_world_camera
    for (sigma_m, sigma_deg), search in ((WIDE, MapSearch(enough=0)), (CLOSE, MapSearch(enough=0, **STRICT))):
        guess = Guess(T, sigma_m, float(np.radians(sigma_deg)), True)
        window = _window(map, T, among, near)
        matches = search.search(view.frame.camera, guess, view.keypoints, view.segments, view.planes, map, window)
        found = _solved(T, view, matches, map)
        if found.unobservable.shape[1]:
            return None
        before, T = T, found.T_world_camera
    if apart(before, T):
        return None
    inliers = np.array([np.count_nonzero(found.points), np.count_nonzero(found.lines), np.count_nonzero(found.planes)], np.int32)
    sought = len(matches.keypoints) + len(matches.segments) + len(matches.planes)
    expected = np.array([len(matches.visible_points), len(matches.visible_lines), 0])
    share = float(inliers @ DETAILS / max(expected @ DETAILS, 1))
    return Recognised(T, found.covariance, inliers, float(inliers.sum() / max(sought, 1)), share, seen_through(T, view.frame, map, window))


def _window(map: Map, T: F64, among: I32, near: int) -> LocalWindow:
    window = local_window(map, T, 0, 0, near, ABOUT_M, ABOUT_DEG, int(map.keyframes.row("submap", int(among[0]))))
    return window if len(window.keyframes) else window_of(map, among)


def _solved(T: F64, view: FrameFeatures, matches: Matches, map: Map) -> PoseSolution:
    none = matches.parallel[:0]
    return solve_pose(
        T,
        view.frame.camera,
        T,
        np.diag(np.repeat([PRIOR_M**-2, np.radians(PRIOR_DEG) ** -2], 3)),
        point_terms(map, view.keypoints, matches.keypoints),
        line_terms(map, view.segments, matches.segments, T, view.frame.camera, LINE_PX),
        plane_terms(map, view.planes, matches.planes, none, none, 1.0),
    )
