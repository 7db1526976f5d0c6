"""Tracking by a learned matcher in an ONNX file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, I32, Camera, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.shared.networks import NetworkOptions, vectors_of
from trihedron.plugins.shared.relative_motion import solve_motion
from trihedron.plugins.tracks.feature_pairs import NO_PAIRS, Features, StructureGates, tracks_value, with_carried_depth


@register("tracks", "onnx_lightglue")
@dataclass(frozen=True)
class OnnxLightGlue(NetworkOptions):
    """Match key points by LightGlue (Lindenberger, Sarlin, Pollefeys, ICCV 2023), or another network with its tensors, without a predicted motion:
    `kpts0`, `kpts1` (1, n, 2), about the image's centre in units of half its longer side, `desc0`, `desc1` (1, n, d); gives `matches0` (m, 2) and
    `mscores0` (m,). It takes the key points of the network that it was trained with, `keypoints=onnx`.

    Outliers remain in the pairs. Lines and planes are then matched by the points' motion. Library: ONNX Runtime (MIT), one thread. The bytes may
    differ on another CPU."""

    slot: ClassVar[str] = "tracks"
    min_score: Share = 0.1  # of a match
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
        gap = keypoints.index - previous_keypoints.index
        if gap > self.max_age:
            return tracks_value(now, before, (NO_PAIRS, NO_PAIRS, NO_PAIRS), np.eye(3))
        points = self._match_keypoints(previous_keypoints, keypoints, camera)
        tracks = tracks_value(now, before, (points, NO_PAIRS, NO_PAIRS), np.eye(3))
        motion = solve_motion(self, camera, tracks, keypoints, segments, planes, gap)
        return tracks_value(now, before, (points, *StructureGates().pairs(now, before, camera, motion.R, motion.t)), motion.R)

    def _match_keypoints(self, before: Keypoints, now: Keypoints, camera: Camera) -> I32:
        """Pairs (n, 2) of rows, each row once, those with the best scores."""
        network = self.network
        if not len(before.pixels) or not len(now.pixels) or before.metric != "l2" or now.metric != "l2":
            return NO_PAIRS
        width = network.inputs["desc0"][0][-1] if "desc0" in network.inputs else None
        width = width if isinstance(width, int) else now.descriptors.shape[1]
        given = {"kpts0": _normalise_pixels(before.pixels, camera), "kpts1": _normalise_pixels(now.pixels, camera)}
        given |= {"desc0": vectors_of(before.descriptors, width)[None], "desc1": vectors_of(now.descriptors, width)[None]}
        outputs = network.run(given, ("matches0", "mscores0"))
        pairs = np.rint(network.rows("matches0", outputs[0], None, 2)).astype(np.int32)
        scores = network.rows("mscores0", outputs[1], len(pairs))
        good = ((pairs >= 0) & (pairs < [len(before.pixels), len(now.pixels)])).all(axis=1) & (scores >= self.min_score)
        pairs = pairs[good][np.argsort(-scores[good], kind="stable")]
        for column in (0, 1):
            pairs = pairs[np.sort(np.unique(pairs[:, column], return_index=True)[1])]
        return np.ascontiguousarray(pairs[np.argsort(pairs[:, 0], kind="stable")], np.int32)


def _normalise_pixels(pixels: F32, camera: Camera) -> F32:
    """Pixels (n, 2) about the image's centre, in units of half its longer side, as (1, n, 2)."""
    size = np.array([camera.width, camera.height], np.float32)
    return np.ascontiguousarray(((pixels - size / 2.0) / (size.max() / 2.0))[None], np.float32)
