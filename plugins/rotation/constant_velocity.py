"""The camera's rotation by constant angular velocity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Keypoints, Map, Pose, Rotation, Tracks
from trihedron.plugins.mapping.reference_keyframe import transform_rotation_to_map
from trihedron.plugins.rotation.estimate import Estimate, rotation_before, rotation_value
from trihedron.plugins.rotation.known_frames import KnownFrames

FEWEST = 3  # features that fix a rotation


@register("rotation", "constant_velocity")
@dataclass(frozen=True)
class ConstantVelocity:
    """Compose the previous rotation with the tracks' `R_current_previous`, which repeats the last rotation where nothing was tracked.

    A baseline, and the fallback of a lost camera; its `source` is always prediction."""

    pose_floor_deg: PositiveFloat = 0.1  # least error of the previous pose
    prior_deg: PositiveFloat = 2.0  # error of a repeated rotation, per frame
    tracked_deg: PositiveFloat = 0.1  # error of a rotation that was estimated from the tracks

    def __call__(
        self, tracks: Tracks | None, keypoints: Keypoints, previous: Rotation | None, previous_pose: Pose | None, map: Map | None
    ) -> Rotation:
        """Return the rotation of this frame; the identity for the first."""
        estimate = Estimate(np.eye(3), np.zeros((3, 3)), "prediction")
        if previous is not None:
            before, _ = rotation_before(*transform_rotation_to_map(previous, previous_pose, map), self.pose_floor_deg)
            reaching = tracks if tracks is not None and tracks.previous_index == previous.index else None
            R_current_previous = np.eye(3) if reaching is None else reaching.R_current_previous
            found = 0 if reaching is None else len(reaching.keypoints) + len(reaching.segments) + len(reaching.planes)
            error_deg = self.tracked_deg if found >= FEWEST else self.prior_deg * max(keypoints.index - previous.index, 1)
            grown = np.eye(3) * np.radians(error_deg) ** 2
            estimate = Estimate(
                matmul(before.R, R_current_previous.T), matmul(R_current_previous, before.covariance, R_current_previous.T) + grown, "prediction"
            )
        return rotation_value(keypoints.index, keypoints.stamp_ns, estimate, KnownFrames.none(), np.zeros((0, 3, 3)))
