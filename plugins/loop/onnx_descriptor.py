"""Loops found by a learned descriptor of the whole image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import partial
from typing import ClassVar

import numpy as np

from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.options import PositiveInt, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, Column, Correction, Frame, Map, PlaceCorrection, Table
from trihedron.plugins.loop.loop_closing import LoopOptions, close_loop, within_reach
from trihedron.plugins.shared.networks import NetworkOptions, network_image

MEAN, SPREAD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)  # of ImageNet's colours


@register("loop", "onnx_descriptor")
@dataclass(frozen=True)
class OnnxDescriptor(NetworkOptions, LoopOptions):
    """Recognise a place by a global descriptor of a network that the user gives (NetVLAD: Arandjelović et al., CVPR 2016; MegaLoc: Berton and Masone,
    CVPRW 2025): RGB `image` (1, 3, h, w) to `descriptor` (1, d). Places are then verified as those of `appearance`.

    It runs on keyframes alone, and the map reads its result 10 frames later: a slow network delays loops and no frame. The descriptors of the
    keyframes are part of its value, a `PlaceCorrection`. Library: ONNX Runtime (MIT), one thread. The bytes may differ on another CPU."""

    slot: ClassVar[str] = "loop"
    multiple: PositiveInt = 14  # of which the image's sides are one
    imagenet: bool = True  # colours are normalised by ImageNet's mean and spread, else in 0 … 1
    min_similarity: Share = 0.5  # cosine between the descriptors of one place
    looked_at: PositiveInt = 50  # keyframes within reach that are compared, the nearest first

    def __call__(self, map: Map, frame: Frame, previous: Correction | None) -> Correction | None:
        """Return the correction, with the descriptors so far; None unless this frame is the newest keyframe."""
        newest = len(map.keyframes) - 1
        if newest < 0 or map.keyframes.row("index", newest) != frame.index:
            return None
        vector = self._describe(frame)
        known = previous.places if isinstance(previous, PlaceCorrection) else None
        places = known if known is not None else Table.empty({"keyframe": Column("i4"), "descriptor": Column("f4", (len(vector),))})
        correction = close_loop(self, partial(self._rank, places=places, vector=vector), map, frame)
        places, _ = places.appended(keyframe=np.array([newest], np.int32), descriptor=vector[None])
        if correction is None:
            correction = _nothing(map)
        return PlaceCorrection(**{one.name: getattr(correction, one.name) for one in fields(Correction)}, places=places)

    def _describe(self, frame: Frame) -> F32:
        """The unit vector (d,) of an image."""
        network = self.network
        tensor = network_image(frame, network, "image", 3, self.multiple).tensor
        if self.imagenet:
            tensor = np.ascontiguousarray((tensor - MEAN[:, None, None]) / SPREAD[:, None, None], np.float32)
        found = network.rows("descriptor", network.run({"image": tensor}, ("descriptor",))[0], None)
        return np.asarray(found / max(float(norm(found)), 1e-12), np.float32)

    def _rank(self, map: Map, places: Table, vector: F32) -> Iterator[tuple[int, float]]:
        """Keyframes within reach, the most similar first, with the length of the path since."""
        rows, path_m = within_reach(self, map, self.looked_at)
        keyframes = places.shared("keyframe")
        similarity = {int(k): float(s) for k, s in zip(keyframes, matmul(places.shared("descriptor"), vector))}
        order = sorted(range(len(rows)), key=lambda i: -similarity.get(int(rows[i]), -1.0))
        yield from ((int(rows[i]), float(path_m[i])) for i in order if similarity.get(int(rows[i]), -1.0) >= self.min_similarity)


def _nothing(map: Map) -> Correction:
    """A correction of nothing."""
    none, points, lines, planes = np.zeros(0, np.int32), np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros((0, 4))
    information = np.zeros((0, 3, 3), np.float32), np.zeros((0, 2, 3, 3), np.float32), np.zeros((0, 3, 3))
    landmarks = none.copy(), points, information[0], none.copy(), lines, information[1], none.copy(), planes, information[2]
    return Correction(map.index, map.stamp_ns, map.revision, none, np.zeros((0, 4, 4)), *landmarks)
