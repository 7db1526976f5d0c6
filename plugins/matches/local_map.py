"""Data association with the local map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.linalg import eigvalsh
from trihedron.pipeline.core.options import NonNegativeInt, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, OK, Camera, Keypoints, Map, Matches, Planes, Pose, Rotation, Segments, Translation
from trihedron.plugins.mapping.covisibility_graph import VICINITY_DEG, VICINITY_M, living_keyframes, local_window
from trihedron.plugins.mapping.data_association import PredictedPose, SearchOptions, search_map


@register("matches", "local_map")
@dataclass(frozen=True)
class LocalMap(SearchOptions):
    """Match the frame's features with the landmarks of a bounded window of keyframes, projected at the decoupled pose, or at the relocalised one of a
    lost camera (sections III-A, IV-C)."""

    newest: PositiveInt = 2  # keyframes always in the window
    covisible: NonNegativeInt = 10  # keyframes that share most landmarks with those
    near: NonNegativeInt = 3  # further keyframes taken from about here
    recognised: PositiveInt = 8  # keyframes taken from about the place where a lost camera was recognised

    def __call__(
        self,
        camera: Camera,
        rotation: Rotation,
        translation: Translation,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        map: Map | None,
        relocalise: Pose | None,
    ) -> Matches | None:
        """Return the matches; None while there is no map."""
        if map is None or not len(living_keyframes(map)):
            return None
        prediction = self._predict(rotation, translation, relocalise)
        if relocalise is not None and relocalise.status == OK:  # the newest keyframes may be far from there
            window = local_window(map, prediction.T_world_camera, 0, 0, self.recognised, VICINITY_M, VICINITY_DEG, relocalise.submap)
        else:
            window = local_window(map, prediction.T_world_camera, self.newest, self.covisible, self.near)
        return search_map(self, camera, prediction, keypoints, segments, planes, map, window)

    def _predict(self, rotation: Rotation, translation: Translation, relocalise: Pose | None) -> PredictedPose:
        if relocalise is not None and relocalise.status == OK:
            return PredictedPose(relocalise.T_world_camera, *_sigmas(relocalise.covariance[:3, :3], relocalise.covariance[3:, 3:]), True)
        T = pose_matrix(rotation.R_world_camera, translation.t_world_camera)
        return PredictedPose(T, *_sigmas(translation.covariance, rotation.covariance), translation.estimated)


def _sigmas(position: F64, rotation: F64) -> tuple[float, float]:
    """Largest standard deviation of each."""
    sigma_m, sigma_rad = np.sqrt(eigvalsh(np.array([position, rotation]))[:, -1]).tolist()
    return sigma_m, sigma_rad
