"""AKAZE key points by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2

from trihedron.pipeline.core.options import PositiveFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Keypoints
from trihedron.plugins.keypoints.lifting import LiftOptions, detect_and_lift
from trihedron.plugins.shared.per_thread import PerThread


@register("keypoints", "akaze")
@dataclass(frozen=True)
class Akaze(LiftOptions):
    """`cv2.xfeatures2d.AKAZE` (Alcantarilla, Nuevo, Bartoli, BMVC 2013) with OpenCV's defaults: extrema of a nonlinear scale space, M-LDB
    descriptors.

    Library: OpenCV contrib (Apache-2.0). The bytes may differ on another CPU: the scale space is computed in single precision."""

    threshold: PositiveFloat = 0.001  # of the detector's response
    octaves: PositiveInt = 4  # nOctaves
    octave_layers: PositiveInt = 4  # nOctaveLayers

    def __call__(self, frame: Frame) -> Keypoints:
        """Key points in OpenCV's order; (n, 61) binary descriptors."""
        return detect_and_lift(self, self._detector(), frame, 4.8, 61, "hamming", 40)

    @cached_property
    def _detector(self) -> PerThread[Any]:
        """OpenCV's detector of each thread."""
        return PerThread(self._make_detector)

    def _make_detector(self) -> Any:
        return cv2.xfeatures2d.AKAZE_create(threshold=self.threshold, nOctaves=self.octaves, nOctaveLayers=self.octave_layers)
