"""LSD line segments with LBD descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2

from trihedron.pipeline.registry import register
from trihedron.pipeline.types import Frame, LineSegments
from trihedron.plugins.numerics.images.straight_edges import SMALLEST, StraightEdges


@register("lines", "lsd")
@dataclass(frozen=True)
class Lsd(StraightEdges):
    """Line segment detector (von Gioi et al., PAMI 2010) on a reduced image, fragments merged, placed to sub-pixel on the full image,
    described by LBD (Zhang & Koch, 2013). Segments are directed with the bright side on their right: start and end keep their meaning over time."""

    def __call__(self, frame: Frame) -> LineSegments:
        """The longest segments, longest first; (n, 32) binary descriptors."""
        small = self._reduced(frame.gray)
        found = self._detector.detect(small)[0] if min(small.shape) >= SMALLEST else None
        return self._segments(frame, small, found)

    @property
    def _detector(self) -> Any:
        """This thread's detector: two frames in one OpenCV LSD object crash the process."""
        if not hasattr(self._local, "lsd"):
            self._local.lsd = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 1.0)
        return self._local.lsd
