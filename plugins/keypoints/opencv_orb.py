"""ORB key points by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import cv2

from trihedron.pipeline.core.options import PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Keypoints
from trihedron.plugins.keypoints.lifting import LiftOptions, detect_and_lift
from trihedron.plugins.shared.per_thread import PerThread


@register("keypoints", "opencv_orb")
@dataclass(frozen=True)
class OpenCvOrb(LiftOptions):
    """`cv2.ORB` (Rublee, Rabaud, Konolige, Bradski, ICCV 2011) with OpenCV's defaults: the strongest corners of the whole image, wherever they are.

    Library: OpenCV (Apache-2.0). The bytes may differ on another CPU: its filters choose instructions by what the CPU has."""

    features: PositiveInt = 500  # nfeatures
    scale: Annotated[float, Range(above=1, high=2)] = 1.2  # scaleFactor
    levels: Annotated[int, Range(1, 16)] = 8  # nlevels
    edge_px: PositiveInt = 31  # edgeThreshold
    fast_threshold: Annotated[int, Range(1, 255)] = 20  # fastThreshold

    def __call__(self, frame: Frame) -> Keypoints:
        """At most `features` key points in OpenCV's order; (n, 32) binary descriptors."""
        return detect_and_lift(self, self._detector(), frame, 31.0, 32, "hamming", 2 * self.edge_px + 1)

    @cached_property
    def _detector(self) -> PerThread[Any]:
        """OpenCV's detector of each thread."""
        return PerThread(self._make_detector)

    def _make_detector(self) -> Any:
        options = {"nfeatures": self.features, "scaleFactor": self.scale, "nlevels": self.levels, "edgeThreshold": self.edge_px}
        return cv2.ORB_create(**options, fastThreshold=self.fast_threshold)
