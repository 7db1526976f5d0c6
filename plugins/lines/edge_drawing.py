"""EDLines segments with LBD descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, LineSegments
from trihedron.plugins.lines.common import SMALLEST, StraightEdges


@register("lines", "edge_drawing")
@dataclass(frozen=True)
class EdgeDrawing(StraightEdges):
    """EDLines (Akinlar & Topal, Pattern Recognition Letters 2011; OpenCV's): edges drawn from anchor to anchor along the gradient's ridges, cut into
    lines that pass a test against chance, then joined, placed to sub-pixel and described like those of `lsd`."""

    scale: float = 0.7  # of the image the detector looks at; at half size plaster draws lines
    band_px: int = 10  # rows of an LBD band, on the reduced image
    merge_gap_px: float = 18.0  # between fragments of one edge; edges drawn are rounded where they turn
    gradient: int = 20  # smallest |gx| + |gy| (Prewitt) of an edge pixel; OpenCV's default
    anchor: int = 0  # how far an anchor's gradient exceeds its neighbours'; OpenCV's default
    straight_px: float = 1.0  # rms distance of a line's pixels from it, Akinlar & Topal
    validated: bool = True  # keep only lines that chance would not draw (number of false alarms below 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.gradient <= 1000 or not 0 <= self.anchor <= 1000:
            raise ValueError("gradient, anchor: must be 1 to 1000 and 0 to 1000")
        if not 0.2 <= self.straight_px <= 5.0:
            raise ValueError("straight_px: must be 0.2 to 5")

    def __call__(self, frame: Frame) -> LineSegments:
        """The longest segments, longest first; (n, 32) binary descriptors."""
        small, found = self._reduced(frame.gray), None
        if min(small.shape) >= SMALLEST:
            detector = self._detector
            detector.detectEdges(small)
            found = detector.detectLines()
        return self._segments(frame, small, found)

    @property
    def _detector(self) -> Any:
        """This thread's detector: it holds the edges between its two steps."""
        if not hasattr(self._local, "edge_drawing"):
            options = cv2.ximgproc.EdgeDrawing.Params()
            options.EdgeDetectionOperator = cv2.ximgproc.EdgeDrawing_PREWITT
            options.GradientThresholdValue, options.AnchorThresholdValue = self.gradient, self.anchor
            options.LineFitErrorThreshold, options.NFAValidation = self.straight_px, self.validated
            self._local.edge_drawing = cv2.ximgproc.createEdgeDrawing()
            self._local.edge_drawing.setParams(options)
        return self._local.edge_drawing
