"""Position with the rotation fixed, by robust Levenberg–Marquardt."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import NonNegativeFloat, NonNegativeInt, PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Camera, Keypoints, Map, Planes, Pose, Rotation, Segments, Tracks, Translation
from trihedron.plugins.mapping.reference_keyframe import transform_to_map
from trihedron.plugins.shared.pose_optimizer import Terms, solve_pose
from trihedron.plugins.shared.relative_motion import pairs_of
from trihedron.plugins.translation.predicted_position import origin, predicted_translation, propagated_covariance
from trihedron.plugins.translation.tracked_terms_kernels import tracked_lines, tracked_planes, tracked_points


@register("translation", "levenberg_marquardt")
@dataclass(frozen=True)
class LevenbergMarquardt:
    """Minimise the reprojection errors of the previous frame's points, lines and planes over the position, with the rotation fixed (eqs. 2–7).

    The previous pose transforms the previous features to the world. The rotation's covariance is added to the noise of the features that it moves, so
    that distances to planes, which it does not move, count for more when it is large. The previous position is a weak prior (`motion_sigma_m`) for
    the directions that no feature observes. Without any measurement the camera is predicted with constant velocity for `predict_frames`, then at
    rest, with growing covariance; `estimated` is then False."""

    motion_sigma_m: PositiveFloat = 0.1  # per frame, of the position about the previous one: 3 m/s at 30 frames/s
    line_sigma_px: PositiveFloat = 1.0  # of a segment's end point across it
    rotation_sigma_deg: NonNegativeFloat = 0.05  # least σ of the fixed rotation
    predict_frames: NonNegativeInt = 15  # half a second: a hand-held camera's velocity is not constant for longer

    def __call__(
        self,
        camera: Camera,
        rotation: Rotation,
        tracks: Tracks | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous_pose: Pose | None,
        earlier_pose: Pose | None,
        map: Map | None,
    ) -> Translation:
        """Return the position; the first frame's is the origin of the world."""
        if previous_pose is None:
            return origin(rotation)
        previous_pose = transform_to_map(previous_pose, map)
        frames = max(rotation.index - previous_pose.index, 1)
        if tracks is None or tracks.previous_index != previous_pose.index:
            return self._predict_position(rotation, previous_pose, earlier_pose, map, frames)
        T, R = previous_pose.T_world_camera, rotation.R_world_camera
        start = pose_matrix(R, T[:3, 3])
        prior = np.diag(np.repeat([(self.motion_sigma_m * frames) ** -2, 1.0], 3))
        uncertain = rotation.covariance + np.radians(self.rotation_sigma_deg) ** 2 * np.eye(3)
        terms = self._terms(tracks, keypoints, segments, planes, camera, T, uncertain)
        found = solve_pose(start, camera, start, prior, *terms, fixed_rotation=True)
        if not (found.points.any() or found.lines.any() or found.planes.any()):
            return self._predict_position(rotation, previous_pose, earlier_pose, map, frames)
        inliers = np.array([np.count_nonzero(kind) for kind in (found.points, found.lines, found.planes)], np.int32)
        unobservable = np.ascontiguousarray(matmul(R, found.unobservable).T)
        covariance = matmul(R, found.covariance, R.T) + propagated_covariance(previous_pose, held_too=True)
        return Translation(rotation.index, rotation.stamp_ns, found.T_world_camera[:3, 3].copy(), covariance, unobservable, inliers, True)

    def _predict_position(self, rotation: Rotation, previous: Pose, earlier: Pose | None, map: Map | None, frames: int) -> Translation:
        """Predict the position by constant velocity, for at most `predict_frames`, else by no motion."""
        t, propagated = previous.T_world_camera[:3, 3].copy(), propagated_covariance(previous, held_too=True)
        recently = np.trace(propagated) / 3.0 < self.predict_frames * self.motion_sigma_m**2
        if earlier is not None and recently:
            t += (t - transform_to_map(earlier, map).T_world_camera[:3, 3]) * frames / (previous.index - earlier.index)
        return predicted_translation(rotation, t, propagated + (self.motion_sigma_m * frames) ** 2 * np.eye(3))

    def _terms(self, tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes, camera: Camera, T: F64, uncertain: F64) -> Terms:
        """Convert the tracks to terms, the previous pose being T (4, 4) and the covariance of the fixed rotation `uncertain` (3, 3)."""
        points, lines, walls = pairs_of(tracks, keypoints, segments, planes)
        T, uncertain = constant(T, np.float64), constant(uncertain, np.float64)
        fx, fy, noise = float(camera.fx), float(camera.fy), camera.depth_noise.coefficients
        return (
            tracked_points(points, fx, fy, T, uncertain),
            tracked_lines(lines, math.hypot(self.line_sigma_px, keypoints.blur_px), noise, fx, fy, T, uncertain),
            tracked_planes(walls, T, uncertain),
        )
