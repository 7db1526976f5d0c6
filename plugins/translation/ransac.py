"""Position with the rotation fixed, from one tracked point at a time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Bool, Keypoints, Map, Pose, Rotation, Tracks, Translation
from trihedron.plugins.mapping.reference_keyframe import anchored
from trihedron.plugins.shared.rigid_alignment import tracked_places
from trihedron.plugins.translation.common import handed_on, origin, unmeasured


@register("translation", "ransac")
@dataclass(frozen=True)
class Ransac:
    """With the rotation known every tracked point with depth in both frames says the whole step: the one most points agree with, then their weighted
    mean (after RGB-D SLAM: Endres et al., T-RO 2014, whose samples of three give both). Fewer than `min_points` are no measurement."""

    rounds: PositiveInt = 100  # points tried
    gate: PositiveFloat = 3.0  # standard deviations within which a point agrees
    min_points: PositiveInt = 12
    motion_sigma_m: PositiveFloat = 0.1  # of a step that is not measured, per frame

    def __call__(
        self, rotation: Rotation, tracks: Tracks | None, keypoints: Keypoints, previous_pose: Pose | None, map: Map | None,
        rng: np.random.Generator,
    ) -> Translation:  # fmt: skip
        """The position; the first frame's is the origin of the world."""
        if previous_pose is None:
            return origin(rotation)
        pose, R = anchored(previous_pose, map), rotation.R_world_camera
        T, unknown = pose.T_world_camera, handed_on(pose)
        if tracks is not None and tracks.previous_index == previous_pose.index:
            before, after, sigma = tracked_places(tracks, keypoints)
            steps = before @ T[:3, :3].T - after @ R.T
            agree = self._agreeing(steps, sigma, rng)
            if agree.sum() >= self.min_points:
                w = 1.0 / sigma[agree] ** 2
                covariance = np.eye(3) / w.sum() + unknown
                inliers = np.array([agree.sum(), 0, 0], np.int32)
                t = T[:3, 3] + w @ steps[agree] / w.sum()
                return Translation(rotation.index, rotation.stamp_ns, t, covariance, np.empty((0, 3)), inliers, True)
        prior_m = self.motion_sigma_m * max(rotation.index - previous_pose.index, 1)
        return unmeasured(rotation, T[:3, 3].copy(), unknown + prior_m**2 * np.eye(3))

    def _agreeing(self, steps: F64, sigma: F64, rng: np.random.Generator) -> Bool:
        """(n,) whether each of the steps (n, 3) agrees with the one that most agree with, and then with their mean."""
        if not len(steps):
            return np.zeros(0, bool)
        tried = steps[rng.integers(0, len(steps), self.rounds)]
        within = np.linalg.norm(steps[None] - tried[:, None], axis=2) < self.gate * sigma
        agree = within[int(np.argmax(within.sum(axis=1)))]
        for _ in range(3):
            if not agree.any():
                break
            mean = (steps[agree] / sigma[agree, None] ** 2).sum(axis=0) / (1.0 / sigma[agree] ** 2).sum()
            agree = np.linalg.norm(steps - mean, axis=1) < self.gate * sigma
        return np.asarray(agree)
