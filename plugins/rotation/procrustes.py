"""The camera's rotation from the tracks alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Camera, Keypoints, Map, Planes, Pose, Rotation, Segments, Tracks
from trihedron.plugins.mapping.reference_keyframe import transform_rotation_to_map
from trihedron.plugins.rotation.estimate import Estimate, rotation_before, rotation_value
from trihedron.plugins.rotation.known_frames import KnownFrames
from trihedron.plugins.rotation.tracked_rotation import compose_with_tracks


@register("rotation", "procrustes")
@dataclass(frozen=True)
class Procrustes:
    """Compose the previous rotation with the one that aligns the tracked points, lines and planes of the two frames.

    It is the fallback of `drift_free`, for comparison; without a Manhattan frame it drifts."""

    pose_floor_deg: PositiveFloat = 0.1  # least error of the previous pose
    prior_deg: PositiveFloat = 2.0  # of the predicted rotation, per frame
    prior_m: PositiveFloat = 0.1  # of the motion, per frame
    measured_deg: PositiveFloat = 1.0  # tracks that leave the rotation less certain than this have not measured it
    angle_px: PositiveFloat = 0.002  # rad, of a pixel
    plane_floor_deg: PositiveFloat = 0.3  # error of a tracked plane's normal
    predict_frames: NonNegativeInt = 15  # half a second without features: a hand-held camera's velocity is not constant for longer

    def __call__(
        self,
        camera: Camera,
        tracks: Tracks | None,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous: Rotation | None,
        previous_pose: Pose | None,
        map: Map | None,
    ) -> Rotation:
        """Return the rotation of this frame; the identity for the first."""
        estimate = Estimate(np.eye(3), np.zeros((3, 3)), "prediction")
        if previous is not None:
            before, _ = rotation_before(*transform_rotation_to_map(previous, previous_pose, map), self.pose_floor_deg)
            estimate = compose_with_tracks(self, camera, before, previous.index, tracks, keypoints, segments, planes)
        return rotation_value(keypoints.index, keypoints.stamp_ns, estimate, KnownFrames.none(), np.zeros((0, 3, 3)))
