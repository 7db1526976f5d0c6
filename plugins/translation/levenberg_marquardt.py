"""Position with the rotation fixed, by robust Levenberg–Marquardt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.options import NonNegativeFloat, NonNegativeInt, PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Camera, Keypoints, Map, Planes, Pose, Rotation, Segments, Tracks, Translation
from trihedron.plugins.mapping.reference_keyframe import anchored
from trihedron.plugins.shared.depth_image import noise_coefficients
from trihedron.plugins.shared.linalg import constant
from trihedron.plugins.shared.pose_optimizer import Terms, solve_pose
from trihedron.plugins.shared.relative_motion import pairs_of
from trihedron.plugins.translation.common import handed_on, origin, unmeasured
from trihedron.plugins.translation.levenberg_marquardt_kernels import tracked_lines, tracked_planes, tracked_points


@register("translation", "levenberg_marquardt")
@dataclass(frozen=True)
class LevenbergMarquardt:
    """Reprojected points, lines and planes of the previous frame with the rotation fixed (eqs. 2–7).

    The previous features are placed in the world by the previous pose. The rotation's own uncertainty is added to the noise of what it moves, so
    that distances to planes, which it does not move, count for more when it is poor. Three weak unknowns remain: the prediction (the previous
    position, `motion_sigma_m`) fills the directions that no feature sees. Without any measurement the camera is taken to keep its velocity for
    `predict_frames`, then to stand still, ever less certain; that is a prediction and says so (`estimated` False)."""

    motion_sigma_m: PositiveFloat = 0.1  # per frame, of the position about the previous one: 3 m/s at 30 frames/s
    line_sigma_px: PositiveFloat = 1.0  # of a segment's end point across it
    rotation_sigma_deg: NonNegativeFloat = 0.05  # least uncertainty granted to the fixed rotation
    predict_frames: NonNegativeInt = 15  # half a second: beyond, a velocity says nothing of a hand

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
        """The position; the first frame's is the origin of the world."""
        if previous_pose is None:
            return origin(rotation)
        previous_pose = anchored(previous_pose, map)
        frames = max(rotation.index - previous_pose.index, 1)
        if tracks is None or tracks.previous_index != previous_pose.index:
            return self._predicted(rotation, previous_pose, earlier_pose, map, frames)
        T, R = previous_pose.T_world_camera, rotation.R_world_camera
        start = pose_matrix(R, T[:3, 3])
        prior = np.diag(np.repeat([(self.motion_sigma_m * frames) ** -2, 1.0], 3))
        uncertain = rotation.covariance + np.radians(self.rotation_sigma_deg) ** 2 * np.eye(3)
        terms = self._terms(tracks, keypoints, segments, planes, camera, T, uncertain)
        found = solve_pose(start, camera, start, prior, *terms, fixed_rotation=True)
        if not (found.points.any() or found.lines.any() or found.planes.any()):
            return self._predicted(rotation, previous_pose, earlier_pose, map, frames)
        inliers = np.array([np.count_nonzero(kind) for kind in (found.points, found.lines, found.planes)], np.int32)
        unobservable = np.ascontiguousarray((R @ found.unobservable).T)
        covariance = R @ found.covariance @ R.T + handed_on(previous_pose, held_too=True)
        return Translation(rotation.index, rotation.stamp_ns, found.T_world_camera[:3, 3].copy(), covariance, unobservable, inliers, True)

    def _predicted(self, rotation: Rotation, previous: Pose, earlier: Pose | None, map: Map | None, frames: int) -> Translation:
        """Where the camera is if it goes on as before, for as long as that may be said, else where it was."""
        t, before = previous.T_world_camera[:3, 3].copy(), handed_on(previous, held_too=True)
        lately = np.trace(before) / 3.0 < self.predict_frames * self.motion_sigma_m**2
        if earlier is not None and lately:
            t += (t - anchored(earlier, map).T_world_camera[:3, 3]) * frames / (previous.index - earlier.index)
        return unmeasured(rotation, t, before + (self.motion_sigma_m * frames) ** 2 * np.eye(3))

    def _terms(self, tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes, camera: Camera, T: F64, uncertain: F64) -> Terms:
        """The tracks, placed in the world by the previous pose T (4, 4) and a rotation of covariance `uncertain` (3, 3)."""
        points, lines, walls = pairs_of(tracks, keypoints, segments, planes)
        T, uncertain = constant(T, np.float64), constant(uncertain, np.float64)
        fx, fy, noise = float(camera.fx), float(camera.fy), noise_coefficients(camera.depth_noise)
        return (
            tracked_points(points, keypoints.pixels, fx, fy, T, uncertain),
            tracked_lines(lines, segments.endpoints_px, self.line_sigma_px, noise, fx, fy, T, uncertain),
            tracked_planes(walls, T, uncertain),
        )
