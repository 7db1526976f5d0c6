"""The camera's rotation from three tracked points at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Keypoints, Map, Pose, Rotation, Tracks
from trihedron.plugins.mapping.reference_keyframe import transform_rotation_to_map
from trihedron.plugins.rotation.estimate import Estimate, rotation_before, rotation_value
from trihedron.plugins.rotation.known_frames import KnownFrames
from trihedron.plugins.shared.rigid_alignment import consensus, fit_covariance, tracked_point_pairs


@register("rotation", "ransac")
@dataclass(frozen=True)
class Ransac:
    """Compose the previous rotation with that of the rigid motion with most inliers among tracked points with depth in both frames (RGB-D SLAM:
    Endres et al., T-RO 2014). With too few inliers it is held (`source` prediction)."""

    rounds: PositiveInt = 200  # samples of three
    gate: PositiveFloat = 3.0  # standard deviations within which a point agrees
    min_points: Annotated[int, Range(3)] = 12
    held_deg: PositiveFloat = 2.0  # error of a rotation that is held, per frame
    pose_floor_deg: PositiveFloat = 0.02  # least error of the previous pose

    def __call__(
        self, tracks: Tracks | None, keypoints: Keypoints, previous: Rotation | None, previous_pose: Pose | None, map: Map | None,
        rng: np.random.Generator,
    ) -> Rotation:  # fmt: skip
        """Return the rotation of this frame; the identity for the first."""
        estimate = Estimate(np.eye(3), np.zeros((3, 3)), "prediction")
        if previous is not None:
            before, _ = rotation_before(*transform_rotation_to_map(previous, previous_pose, map), self.pose_floor_deg)
            held = before.covariance + np.eye(3) * np.radians(self.held_deg) ** 2
            estimate = Estimate(before.R, held, "prediction")
            if tracks is not None and tracks.previous_index == previous.index:
                points, after, sigma = tracked_point_pairs(tracks, keypoints)
                found = consensus(points, after, sigma, self.gate, self.rounds, rng)
                if found.agree.sum() >= self.min_points:
                    added = fit_covariance(after[found.agree] - after[found.agree].mean(axis=0), sigma[found.agree])[3:, 3:]
                    estimate = Estimate(matmul(before.R, found.R.T), matmul(found.R, before.covariance, found.R.T) + added, "tracks")
        return rotation_value(keypoints.index, keypoints.stamp_ns, estimate, KnownFrames.none(), np.zeros((0, 3, 3)))
