"""SIFT key points by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2

from trihedron.pipeline.core.options import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Keypoints
from trihedron.plugins.keypoints.lifting import LiftOptions, detect_and_lift
from trihedron.plugins.shared.per_thread import PerThread


@register("keypoints", "sift")
@dataclass(frozen=True)
class Sift(LiftOptions):
    """`cv2.SIFT` (Lowe, IJCV 2004) with OpenCV's defaults: extrema of differences of Gaussians, histograms of gradients.

    Library: OpenCV (Apache-2.0; the patent expired in 2020). Descriptors are compared by Euclidean distance. The bytes may differ on another CPU."""

    features: NonNegativeInt = 0  # nfeatures, the strongest; 0 = all
    octave_layers: PositiveInt = 3  # nOctaveLayers
    contrast_threshold: NonNegativeFloat = 0.04  # contrastThreshold
    edge_threshold: PositiveFloat = 10.0  # edgeThreshold
    blur_px: PositiveFloat = 1.6  # sigma, of the first octave

    def __call__(self, frame: Frame) -> Keypoints:
        """Key points in OpenCV's order; (n, 128) descriptors, `metric` l2."""
        return detect_and_lift(self, self._detector(), frame, 2.0 * self.blur_px, 128, "l2", 8)

    @cached_property
    def _detector(self) -> PerThread[Any]:
        """OpenCV's detector of each thread."""
        return PerThread(self._make_detector)

    def _make_detector(self) -> Any:
        thresholds = {"contrastThreshold": self.contrast_threshold, "edgeThreshold": self.edge_threshold}
        return cv2.SIFT_create(nfeatures=self.features, nOctaveLayers=self.octave_layers, sigma=self.blur_px, **thresholds)
