"""EDLines segments with LBD descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import cv2

from trihedron.pipeline.core.options import NonNegativeFloat, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, LineSegments
from trihedron.plugins.lines.segment_completion import MIN_SIDE_PX, LineOptions, line_segments, reduce_image
from trihedron.plugins.shared.per_thread import PerThread


@register("lines", "edge_drawing")
@dataclass(frozen=True)
class EdgeDrawing(LineOptions):
    """EDLines (Akinlar & Topal, Pattern Recognition Letters 2011; OpenCV's): edges drawn from anchor to anchor along the gradient's ridges, cut into
    lines that pass a test against chance, then joined, placed to sub-pixel and described like those of `lsd`."""

    scale: Annotated[float, Range(0.1, 1)] = 0.7  # of the image the detector looks at; at half size plaster draws lines
    band_px: Annotated[int, Range(1, 31)] = 10  # rows of an LBD band, on the reduced image
    merge_gap_px: NonNegativeFloat = 18.0  # between fragments of one edge; edges drawn are rounded where they turn
    gradient: Annotated[int, Range(1, 1000)] = 20  # smallest |gx| + |gy| (Prewitt) of an edge pixel; OpenCV's default
    anchor: Annotated[int, Range(0, 1000)] = 0  # how far an anchor's gradient exceeds its neighbours'; OpenCV's default
    straight_px: Annotated[float, Range(0.2, 5)] = 1.0  # rms distance of a line's pixels from it, Akinlar & Topal
    validated: bool = True  # keep only lines that chance would not draw (number of false alarms below 1)

    def __call__(self, frame: Frame) -> LineSegments:
        """The longest segments, longest first; (n, 32) binary descriptors."""
        small, found = reduce_image(self, frame.gray), None
        if min(small.shape) >= MIN_SIDE_PX:
            detector = self._detector()
            detector.detectEdges(small)
            found = detector.detectLines()
        return line_segments(self, frame, small, found)

    @cached_property
    def _detector(self) -> PerThread[Any]:
        """The detector of each thread: it holds the edges between its two steps."""
        return PerThread(self._make_detector)

    def _make_detector(self) -> Any:
        options = cv2.ximgproc.EdgeDrawing.Params()
        options.EdgeDetectionOperator = cv2.ximgproc.EdgeDrawing_PREWITT
        options.GradientThresholdValue, options.AnchorThresholdValue = self.gradient, self.anchor
        options.LineFitErrorThreshold, options.NFAValidation = self.straight_px, self.validated
        detector = cv2.ximgproc.createEdgeDrawing()
        detector.setParams(options)
        return detector
