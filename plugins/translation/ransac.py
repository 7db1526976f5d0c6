"""Position with the rotation fixed, from one tracked point at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Keypoints, Map, Pose, Rotation, Tracks, Translation
from trihedron.plugins.mapping.reference_keyframe import transform_to_map
from trihedron.plugins.shared.rigid_alignment import tracked_point_pairs
from trihedron.plugins.translation.predicted_position import origin, predicted_translation, propagated_covariance
from trihedron.plugins.translation.ransac_kernels import step_inliers


@register("translation", "ransac")
@dataclass(frozen=True)
class Ransac:
    """RANSAC over single points: with a known rotation one tracked point with depth in both frames determines the translation. The hypothesis with
    most inliers is refined to their weighted mean (after RGB-D SLAM: Endres et al., T-RO 2014, whose samples of three give both). With fewer than
    `min_points` inliers the camera is predicted at rest."""

    rounds: PositiveInt = 100  # points tried as hypotheses
    gate: PositiveFloat = 3.0  # standard deviations within which a point agrees
    min_points: PositiveInt = 12
    motion_sigma_m: PositiveFloat = 0.1  # of a translation that is not measured, per frame

    def __call__(
        self, rotation: Rotation, tracks: Tracks | None, keypoints: Keypoints, previous_pose: Pose | None, map: Map | None,
        rng: np.random.Generator,
    ) -> Translation:  # fmt: skip
        """Return the position; the first frame's is the origin of the world."""
        if previous_pose is None:
            return origin(rotation)
        pose, R = transform_to_map(previous_pose, map), rotation.R_world_camera
        T, propagated = pose.T_world_camera, propagated_covariance(pose)
        if tracks is not None and tracks.previous_index == previous_pose.index:
            before, after, sigma = tracked_point_pairs(tracks, keypoints)
            translations = matmul(before, T[:3, :3].T) - matmul(after, R.T)
            agree = step_inliers(translations, self.gate * sigma, rng.integers(0, max(len(translations), 1), self.rounds))
            if agree.sum() >= self.min_points:
                w = 1.0 / sigma[agree] ** 2
                covariance = np.eye(3) / w.sum() + propagated
                inliers = np.array([agree.sum(), 0, 0], np.int32)
                t = T[:3, 3] + matmul(w, translations[agree]) / w.sum()
                return Translation(rotation.index, rotation.stamp_ns, t, covariance, np.empty((0, 3)), inliers, True)
        prior_m = self.motion_sigma_m * max(rotation.index - previous_pose.index, 1)
        return predicted_translation(rotation, T[:3, 3].copy(), propagated + prior_m**2 * np.eye(3))
