"""Relocalisation by COLMAP's LO-RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, Map, Rotation
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.places.verification import FrameFeatures
from trihedron.plugins.relocalise.features import Features
from trihedron.plugins.shared.feature_matching import mutual_matches
from trihedron.plugins.shared.pycolmap_pose import absolute_pose


@register("relocalise", "pycolmap_pnp")
@dataclass(frozen=True)
class PycolmapPnp(Features):
    """One hypothesis by `pycolmap.estimate_and_refine_absolute_pose` (LO-RANSAC: Chum, Matas, Kittler, DAGM 2003) from points whose descriptors are
    mutual nearest neighbours of the map's; verified as those of `features`. Lines and planes make no hypothesis.

    Depth is not used, and descriptors of either metric are. Library: COLMAP (BSD; Schönberger and Frahm, CVPR 2016), one thread, seeded for each
    frame. The bytes may differ on another CPU."""

    max_error_px: PositiveFloat = 12.0  # of an inlier; COLMAP's own for absolute poses

    def _by_points(self, view: FrameFeatures, map: Map, among: I32, rng: np.random.Generator) -> F64:
        """(n, 4, 4) poses, none or one."""
        ids, seed = observed_by(map, among, "point"), int(rng.integers(2**31 - 1))
        pairs = mutual_matches(map.points.rows("descriptor", ids), view.keypoints.descriptors, view.keypoints.metric, self.ratio)
        known = map.points.rows("position_m", ids[pairs[:, 0]])
        found = absolute_pose(known, view.keypoints.pixels[pairs[:, 1]], view.frame.camera, self.max_error_px, seed)
        return np.empty((0, 4, 4)) if found is None else invert(pose_matrix(found.R, found.t))[None]

    def _by_layout(self, view: FrameFeatures, map: Map, among: I32, rotation: Rotation) -> F64:
        """(0, 4, 4): no hypotheses."""
        return np.empty((0, 4, 4))
