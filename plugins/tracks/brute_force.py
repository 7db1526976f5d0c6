"""Tracking by exhaustive descriptor matching."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, PositiveShare
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Camera, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.shared.feature_matching import mutual_matches
from trihedron.plugins.shared.relative_motion import solve_motion
from trihedron.plugins.tracks.feature_pairs import NO_PAIRS, Features, StructureGates, tracks_value, with_carried_depth


@register("tracks", "brute_force")
@dataclass(frozen=True)
class BruteForce:
    """Match key points whose descriptors are mutual nearest neighbours (RGB-D SLAM: Endres et al., T-RO 2014), without a predicted motion.

    Outliers remain in the pairs. Lines and planes are then matched by the points' motion."""

    ratio: PositiveShare = 0.9  # best to second best descriptor
    max_age: PositiveInt = 10  # frames; older features are not matched
    prior_deg: PositiveFloat = 10.0  # of no rotation, per frame
    prior_m: PositiveFloat = 0.1  # of no translation, per frame
    angle_px: PositiveFloat = 0.002  # rad, of a pixel
    plane_floor_deg: PositiveFloat = 0.3

    def __call__(
        self,
        camera: Camera,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous_keypoints: Keypoints | None,
        previous_segments: Segments | None,
        previous_planes: Planes | None,
        previous: Tracks | None,
    ) -> Tracks | None:
        """Return the pairs with the previous frame; None for the first frame, no pairs when the previous features are too old."""
        if previous_keypoints is None or previous_segments is None or previous_planes is None:
            return None
        now = Features(keypoints, segments, planes)
        before = with_carried_depth(Features(previous_keypoints, previous_segments, previous_planes), previous, self, camera)
        gap = keypoints.index - before.keypoints.index
        if gap > self.max_age:
            return tracks_value(now, before, (NO_PAIRS, NO_PAIRS, NO_PAIRS), np.eye(3))
        points = mutual_matches(before.keypoints.descriptors, keypoints.descriptors, keypoints.metric, self.ratio)
        tracks = tracks_value(now, before, (points, NO_PAIRS, NO_PAIRS), np.eye(3))
        motion = solve_motion(self, camera, tracks, keypoints, segments, planes, gap)
        return tracks_value(now, before, (points, *StructureGates().pairs(now, before, camera, motion.R, motion.t)), motion.R)
