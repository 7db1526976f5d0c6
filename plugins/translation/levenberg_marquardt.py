"""Position with the rotation fixed, by robust Levenberg–Marquardt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.geometry import pose_matrix
from trihedron.pipeline.registry import register
from trihedron.pipeline.types import F64, Frame, Keypoints, Map, Planes, Pose, Rotation, Segments, Tracks, Translation
from trihedron.plugins.numerics.maps.anchoring import anchored
from trihedron.plugins.numerics.motion.pose_solver import solve_pose
from trihedron.plugins.numerics.motion.pose_terms import SAME, LineTerms, PlaneTerms, PointTerms
from trihedron.plugins.numerics.motion.positions import handed_on, origin, unmeasured
from trihedron.plugins.numerics.motion.tracked_terms import placed_planes, placed_points


@register("translation", "levenberg_marquardt")
@dataclass(frozen=True)
class LevenbergMarquardt:
    """Reprojected points, lines and planes of the previous frame with the rotation fixed (eqs. 2–7).

    The previous features are placed in the world by the previous pose. The rotation's own uncertainty is added to the noise of what it moves, so
    that distances to planes, which it does not move, count for more when it is poor. Three weak unknowns remain: the prediction (the previous
    position, `motion_sigma_m`) fills the directions that no feature sees. Without any measurement the camera is taken to keep its velocity for
    `predict_frames`, then to stand still, ever less certain; that is a prediction and says so (`estimated` False)."""

    motion_sigma_m: float = 0.1  # per frame, of the position about the previous one: 3 m/s at 30 frames/s
    line_sigma_px: float = 1.0  # of a segment's end point across it
    rotation_sigma_deg: float = 0.05  # least uncertainty granted to the fixed rotation
    predict_frames: int = 15  # half a second: beyond, a velocity says nothing of a hand

    def __post_init__(self) -> None:
        if self.motion_sigma_m <= 0.0 or self.line_sigma_px <= 0.0 or self.rotation_sigma_deg < 0.0:
            raise ValueError("motion_sigma_m, line_sigma_px, rotation_sigma_deg: must be positive")
        if self.predict_frames < 0:
            raise ValueError("predict_frames: must not be negative")

    def __call__(
        self,
        frame: Frame,
        rotation: Rotation,
        tracks: Tracks | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous_pose: Pose | None,
        earlier_pose: Pose | None,
        map: Map | None,
    ) -> Translation:
        """The position; the first frame's is the origin of the world."""
        if previous_pose is None:
            return origin(frame)
        previous_pose = anchored(previous_pose, map)
        earlier_pose = anchored(earlier_pose, map) if earlier_pose is not None else None
        start = pose_matrix(rotation.R_world_camera, previous_pose.T_world_camera[:3, 3])
        frames = max(frame.index - previous_pose.index, 1)
        prior = np.diag(np.repeat([(self.motion_sigma_m * frames) ** -2, 1.0], 3))
        if tracks is None or tracks.previous_index != previous_pose.index:
            return self._predicted(frame, previous_pose, earlier_pose, frames)
        T = previous_pose.T_world_camera
        uncertain = rotation.covariance + np.radians(self.rotation_sigma_deg) ** 2 * np.eye(3)
        found = solve_pose(
            start,
            frame.camera,
            start,
            prior,
            self._points(tracks, keypoints, T, frame, uncertain),
            self._lines(tracks, segments, T, frame, uncertain),
            self._planes(tracks, planes, T, uncertain),
            fixed_rotation=True,
        )
        if not (found.points.any() or found.lines.any() or found.planes.any()):
            return self._predicted(frame, previous_pose, earlier_pose, frames)
        R = rotation.R_world_camera
        inliers = np.array([np.count_nonzero(kind) for kind in (found.points, found.lines, found.planes)], np.int32)
        unobservable = np.ascontiguousarray((R @ found.unobservable).T)
        covariance = R @ found.covariance @ R.T + handed_on(previous_pose, held_too=True)
        return Translation(frame.index, frame.stamp_ns, found.T_world_camera[:3, 3].copy(), covariance, unobservable, inliers, True)

    def _predicted(self, frame: Frame, previous: Pose, earlier: Pose | None, frames: int) -> Translation:
        """Where the camera is if it goes on as before, for as long as that may be said, else where it was."""
        t, before = previous.T_world_camera[:3, 3].copy(), handed_on(previous, held_too=True)
        lately = np.trace(before) / 3.0 < self.predict_frames * self.motion_sigma_m**2
        if earlier is not None and lately:
            t += (t - earlier.T_world_camera[:3, 3]) * frames / (previous.index - earlier.index)
        return unmeasured(frame, t, before + (self.motion_sigma_m * frames) ** 2 * np.eye(3))

    def _points(self, tracks: Tracks, keypoints: Keypoints, T: F64, frame: Frame, uncertain: F64) -> PointTerms:
        """Tracked key points whose previous depth is known."""
        known = np.isfinite(tracks.points_m).all(axis=1)
        rows = tracks.keypoints[known, 1]
        sigma_px = keypoints.sigma_px[rows]
        return PointTerms(
            *placed_points(tracks.points_m[known], sigma_px, tracks.sigma_m[known], frame.camera, T, uncertain),
            keypoints.pixels[rows].astype(np.float64),
            keypoints.points_m[rows, 2].astype(np.float64),
            sigma_px.astype(np.float64),
            keypoints.sigma_m[rows].astype(np.float64),
        )

    def _lines(self, tracks: Tracks, segments: Segments, T: F64, frame: Frame, uncertain: F64) -> LineTerms:
        """Tracked lines whose previous 3D end points are known."""
        known = np.isfinite(tracks.endpoints_m).all(axis=(1, 2))
        rows = tracks.segments[known, 1]
        ends = tracks.endpoints_m[known].reshape(-1, 3)
        sigma_px, sigma_m = np.full(len(ends), self.line_sigma_px), frame.camera.depth_noise.sigma_m(ends[:, 2].astype(np.float64))
        world, covariance = placed_points(ends, sigma_px, sigma_m, frame.camera, T, uncertain)
        return LineTerms(
            world.reshape(-1, 2, 3),
            covariance.reshape(-1, 2, 3, 3),
            segments.endpoints_px[rows].astype(np.float64),
            np.full(len(rows), self.line_sigma_px),
            segments.endpoints_m[rows].astype(np.float64),
            segments.covariance_m2[rows].astype(np.float64),
        )

    def _planes(self, tracks: Tracks, planes: Planes, T: F64, uncertain: F64) -> PlaneTerms:
        """Tracked planes."""
        rows = tracks.planes[:, 1]
        observed = planes.coefficients[rows]
        world, covariance, turned = placed_planes(tracks.coefficients, tracks.plane_covariance, observed, T, uncertain)
        return PlaneTerms(np.full(len(rows), SAME, np.int32), world, covariance, observed, planes.covariance[rows] + turned)
