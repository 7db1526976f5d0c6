"""Relocalisation by COLMAP's LO-RANSAC."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, Frame, Keypoints, Map, Planes, Pose, Segments
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.mapping.landmark_kinds import POINT
from trihedron.plugins.places.verification import FrameFeatures
from trihedron.plugins.relocalise.hypothesis_verification import RelocaliseOptions, recognise
from trihedron.plugins.shared.feature_matching import mutual_matches
from trihedron.plugins.shared.pycolmap_pose import absolute_pose


@register("relocalise", "pycolmap_pnp")
@dataclass(frozen=True)
class PycolmapPnp(RelocaliseOptions):
    """One hypothesis by `pycolmap.estimate_and_refine_absolute_pose` (LO-RANSAC: Chum, Matas, Kittler, DAGM 2003) from points whose descriptors are
    mutual nearest neighbours of the map's; verified as those of `features`. Lines and planes make no hypothesis.

    Depth is not used, and descriptors of either metric are. Library: COLMAP (BSD; Schönberger and Frahm, CVPR 2016), one thread, seeded for each
    frame. The bytes may differ on another CPU."""

    max_error_px: PositiveFloat = 12.0  # of an inlier; COLMAP's own for absolute poses

    def __call__(
        self,
        frame: Frame,
        keypoints: Keypoints,
        segments: Segments,
        planes: Planes,
        map: Map | None,
        previous_pose: Pose | None,
        rng: np.random.Generator,
    ) -> Pose | None:
        """Return the pose; for a lost camera that is not recognised the lost one, and else None."""
        return recognise(self, (partial(self._by_points, rng=rng),), FrameFeatures(frame, keypoints, segments, planes), map, previous_pose)

    def _by_points(self, view: FrameFeatures, map: Map, keyframes: I32, rng: np.random.Generator) -> F64:
        """(n, 4, 4) poses, none or one."""
        ids, seed = observed_by(map, keyframes, POINT), int(rng.integers(2**31 - 1))
        pairs = mutual_matches(map.points.rows("descriptor", ids), view.keypoints.descriptors, view.keypoints.metric, self.ratio)
        known = map.points.rows("position_m", ids[pairs[:, 0]])
        found = absolute_pose(known, view.keypoints.pixels[pairs[:, 1]], view.frame.camera, self.max_error_px, seed)
        return np.empty((0, 4, 4)) if found is None else invert(pose_matrix(found.R, found.t))[None]
