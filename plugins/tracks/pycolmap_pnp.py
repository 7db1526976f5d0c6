"""Tracking by descriptors and COLMAP's LO-RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, PositiveShare
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Camera, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.shared.feature_matching import mutual_matches
from trihedron.plugins.shared.pycolmap_pose import absolute_pose
from trihedron.plugins.tracks.feature_pairs import NO_PAIRS, Features, StructureGates, tracks_value


@register("tracks", "pycolmap_pnp")
@dataclass(frozen=True)
class PycolmapPnp:
    """Mutual nearest descriptors of the whole image, of which `pycolmap.estimate_and_refine_absolute_pose` (LO-RANSAC: Chum, Matas, Kittler, DAGM
    2003) retains those that agree with one motion: it needs no prediction, so that a wide baseline may lie between the frames.

    Points need depth in the previous frame; lines and planes are matched by the points' motion. Library: COLMAP (BSD; Schönberger and Frahm, CVPR
    2016), one thread, seeded for each frame. The bytes may differ on another CPU."""

    ratio: PositiveShare = 0.9  # best to second best descriptor
    max_error_px: PositiveFloat = 4.0  # of an inlier; COLMAP's own for pairs of images
    min_inliers: PositiveInt = 12  # below which nothing is tracked
    max_age: PositiveInt = 30  # frames; older features are not matched

    def __call__(
        self,
        camera: Camera,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        previous_keypoints: Keypoints | None,
        previous_segments: Segments | None,
        previous_planes: Planes | None,
        rng: np.random.Generator,
    ) -> Tracks | None:
        """Return the pairs with the previous frame; None for the first frame, no pairs when too few points agree."""
        if previous_keypoints is None or previous_segments is None or previous_planes is None:
            return None
        now, before = Features(keypoints, segments, planes), Features(previous_keypoints, previous_segments, previous_planes)
        seed = int(rng.integers(2**31 - 1))
        if keypoints.index - previous_keypoints.index <= self.max_age:
            pairs = mutual_matches(previous_keypoints.descriptors, keypoints.descriptors, keypoints.metric, self.ratio)
            pairs = pairs[np.isfinite(previous_keypoints.points_m[pairs[:, 0], 2])]
            found = absolute_pose(previous_keypoints.points_m[pairs[:, 0]], keypoints.pixels[pairs[:, 1]], camera, self.max_error_px, seed)
            if found is not None and found.inliers.sum() >= self.min_inliers:
                points = np.ascontiguousarray(pairs[found.inliers])
                return tracks_value(now, before, (points, *StructureGates().pairs(now, before, camera, found.R, found.t)), found.R)
        return tracks_value(now, before, (NO_PAIRS, NO_PAIRS, NO_PAIRS), np.eye(3))
