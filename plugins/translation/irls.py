"""Position with the rotation fixed, by iteratively reweighted linear least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Camera, Keypoints, Map, Pose, Rotation, Tracks, Translation
from trihedron.plugins.mapping.reference_keyframe import transform_to_map
from trihedron.plugins.translation.linear_translation import point_equations, solve_translation
from trihedron.plugins.translation.predicted_position import origin, predicted_translation, propagated_covariance


@register("translation", "irls")
@dataclass(frozen=True)
class Irls:
    """The de-rotated reprojection error of tracked points, linear once the rotation is known: of those with depth (OPVO: Kim, Coltin, Kim, BMVC
    2017), with `depthless` of those without as well (LPVO: the same, ICRA 2018; the paper's column "LPVO"). Lines and planes are not used.

    With fewer than `min_points` inliers the camera is predicted at rest, and `estimated` is False."""

    depthless: bool = True  # points without depth constrain the direction of the translation
    motion_sigma_m: PositiveFloat = 0.1  # of the translation, per frame: a weak prior for unobservable directions
    min_points: Annotated[int, Range(3)] = 6

    def __call__(
        self,
        camera: Camera,
        rotation: Rotation,
        tracks: Tracks | None,
        keypoints: Keypoints,
        previous_keypoints: Keypoints | None,
        previous_pose: Pose | None,
        map: Map | None,
    ) -> Translation:
        """Return the position; the first frame's is the origin of the world."""
        if previous_pose is None:
            return origin(rotation)
        pose = transform_to_map(previous_pose, map)
        before, propagated = pose.T_world_camera, propagated_covariance(pose)
        prior_m = self.motion_sigma_m * max(rotation.index - previous_pose.index, 1)
        R = rotation.R_world_camera
        if tracks is not None and previous_keypoints is not None and tracks.previous_index == previous_pose.index == previous_keypoints.index:
            equations = point_equations(
                tracks, keypoints, previous_keypoints, camera, matmul(R.T, before[:3, :3]), rotation.covariance, self.depthless
            )
            found = solve_translation(equations, np.zeros(3), prior_m)
            if found.inliers >= self.min_points:
                inliers = np.array([found.inliers, 0, 0], np.int32)
                covariance = matmul(R, found.covariance, R.T) + propagated
                held = np.ascontiguousarray(matmul(found.unobservable, R.T))
                return Translation(rotation.index, rotation.stamp_ns, before[:3, 3] - matmul(R, found.s), covariance, held, inliers, True)
        return predicted_translation(rotation, before[:3, 3].copy(), propagated + prior_m**2 * np.eye(3))
