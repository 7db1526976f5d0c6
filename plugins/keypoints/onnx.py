"""Learned key points by a network in an ONNX file."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, NamedTuple

import numpy as np

from trihedron.pipeline.core.options import NonNegativeFloat, NonNegativeInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Keypoints
from trihedron.plugins.keypoints.lifting import LiftOptions, lift_keypoints
from trihedron.plugins.shared.networks import NetworkOptions, bytes_of, network_image


class KeypointNetwork(Enum):
    """Names of published networks, each with its preset."""

    superpoint = "superpoint"
    aliked = "aliked"
    xfeat = "xfeat"
    disk = "disk"


class Preset(NamedTuple):
    """Names of a network's tensors and what it expects: an image (1, channels, h, w) in 0 … 1 whose sides are multiples of a number; key points
    (1, n, 2) in pixels (x, y), or from -1 to 1 across the image; scores (1, n); descriptors (1, n, d)."""

    image: str
    channels: int
    multiple: int
    normalised: bool
    keypoints: str = "keypoints"
    scores: str = "scores"
    descriptors: str = "descriptors"


PRESETS = {
    KeypointNetwork.superpoint: Preset("image", 1, 8, False),
    KeypointNetwork.aliked: Preset("image", 3, 32, True),
    KeypointNetwork.xfeat: Preset("images", 3, 32, False),
    KeypointNetwork.disk: Preset("image", 3, 16, False),
}


@register("keypoints", "onnx")
@dataclass(frozen=True)
class OnnxKeypoints(NetworkOptions, LiftOptions):
    """Key points and descriptors of a network that the user gives: SuperPoint (DeTone et al., CVPRW 2018), ALIKED (Zhao et al., T-IM 2023), XFeat
    (Potje et al., CVPR 2024), DISK (Tyszkiewicz et al., NeurIPS 2020), or any other with the tensors of one of them.

    Descriptors are bytes of unit vectors, compared by Euclidean distance. Library: ONNX Runtime (MIT), one thread. The bytes may differ on another
    CPU."""

    slot: ClassVar[str] = "keypoints"
    preset: KeypointNetwork = KeypointNetwork.superpoint  # names of tensors and pre-processing
    features: NonNegativeInt = 1000  # most key points, those with the best scores; 0 = all
    min_score: NonNegativeFloat = 0.0

    def __call__(self, frame: Frame) -> Keypoints:
        """Key points, best first; (n, d) descriptors, d at least 128, `metric` l2."""
        preset, network = PRESETS[self.preset], self.network
        image = network_image(frame, network, preset.image, preset.channels, preset.multiple)
        outputs = network.run({preset.image: image.tensor}, (preset.keypoints, preset.scores, preset.descriptors))
        found = network.rows(preset.keypoints, outputs[0], None, 2).astype(np.float64)
        scores = network.rows(preset.scores, outputs[1], len(found))
        descriptors = network.rows(preset.descriptors, outputs[2], len(found), None)
        if preset.normalised:
            found = (found + 1.0) / 2.0 * (np.array(image.tensor.shape[:1:-1]) - 1.0)
        pixels = image.pixels(found)
        height, width = frame.gray.shape
        inside = ((pixels >= 0.0) & (pixels <= [width - 1, height - 1])).all(axis=1) & (scores >= self.min_score)
        order = np.flatnonzero(inside)[np.argsort(-scores[inside], kind="stable")][: self.features or None]
        alike = np.ones(len(order)), np.zeros(len(order), np.uint8), np.zeros(len(order), np.float32)  # one scale, no direction
        return lift_keypoints(self, frame, np.ascontiguousarray(pixels[order], np.float32), *alike, bytes_of(descriptors[order]), "l2")
