"""Data association with single keyframes by descriptors alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt, PositiveShare, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import I32, Camera, Keypoints, Map, Matches, Rotation
from trihedron.plugins.mapping.covisibility_graph import current_submap, keyframes_of, observed_by
from trihedron.plugins.mapping.landmark_kinds import POINT
from trihedron.plugins.shared.feature_matching import mutual_matches
from trihedron.plugins.shared.rigid_alignment import consensus, point_pair_sigma, rows_with_depth

NO_PAIRS = np.zeros((0, 2), np.int32)


@register("matches", "keyframes")
@dataclass(frozen=True)
class Keyframes:
    """Match this frame with the newest keyframes and some drawn from all earlier ones, by descriptors, each verified by the rigid motion with most
    inliers (RGB-D SLAM: Endres et al., T-RO 2014): edges of a pose graph. No pose is predicted, so a loop of any length can close; a point that two
    keyframes have in common is matched with the one with more inliers."""

    newest: PositiveInt = 3
    drawn: NonNegativeInt = 3  # of the earlier ones, anew in every frame
    ratio: PositiveShare = 0.9  # best to second best descriptor
    rounds: PositiveInt = 150  # samples of three
    gate: PositiveFloat = 3.0  # standard deviations within which a pair agrees
    min_points: Annotated[int, Range(3)] = 25  # that must agree
    min_share: Share = 0.4  # of the pairs

    def __call__(self, camera: Camera, rotation: Rotation, keypoints: Keypoints, map: Map | None, rng: np.random.Generator) -> Matches:
        """Return the pairs of key points and points of verified keyframes; these points count as visible."""
        pairs = [self._verified_matches(camera, keypoints, map, row, rng) for row in self._candidates(map, rng)] if map is not None else []
        pairs = sorted(pairs, key=len, reverse=True)
        found = np.concatenate([NO_PAIRS, *pairs])
        for column in (0, 1):
            _, first = np.unique(found[:, column], return_index=True)
            found = found[np.sort(first)]
        none = np.zeros(0, np.int32)
        ids = np.unique(found[:, 1]).astype(np.int32)
        revision = -1 if map is None else map.revision
        lines_and_planes = (NO_PAIRS,) * 4
        return Matches(keypoints.index, keypoints.stamp_ns, revision, np.ascontiguousarray(found), *lines_and_planes, ids, none)

    def _candidates(self, map: Map, rng: np.random.Generator) -> list[int]:
        """Keyframes that are tried."""
        rows = keyframes_of(map, current_submap(map))
        newest, earlier = rows[-self.newest :], rows[: -self.newest]
        drawn = rng.choice(earlier, min(self.drawn, len(earlier)), replace=False) if len(earlier) else earlier
        return [int(row) for row in (*newest, *np.sort(drawn))]

    def _verified_matches(self, camera: Camera, keypoints: Keypoints, map: Map, keyframe: int, rng: np.random.Generator) -> I32:
        """Rows of key points and ids of the keyframe's points (n, 2) that agree on one motion; none where too few do."""
        ids, mine = observed_by(map, np.array([keyframe], np.int32), POINT), rows_with_depth(keypoints)
        descriptors, positions = map.points.columns_at(ids, "descriptor", "position_m")
        found = mutual_matches(descriptors, keypoints.descriptors[mine], keypoints.metric, self.ratio)
        if len(found) < self.min_points:
            return NO_PAIRS
        T_camera_world = invert(map.keyframes.rows("T_world_camera", np.array([keyframe]))[0])
        there, rows = transform(T_camera_world, positions[found[:, 0]]), mine[found[:, 1]]
        here = keypoints.points_m[rows].astype(np.float64)
        known = camera.depth_noise.sigma_m(there[:, 2])
        sigma = point_pair_sigma(there, here, known, keypoints.sigma_m[rows], keypoints.sigma_px[rows])
        agree = consensus(there, here, sigma, self.gate, self.rounds, rng).agree
        if agree.sum() < self.min_points or agree.sum() < self.min_share * len(found):
            return NO_PAIRS
        return np.stack([rows[agree], ids[found[agree, 0]]], axis=1).astype(np.int32)
