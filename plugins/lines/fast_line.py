"""Line segments along Canny edges, with LBD descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import cv2

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, Range, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, LineSegments
from trihedron.plugins.lines.segment_completion import MIN_SIDE_PX, LineOptions, line_segments, reduce_image
from trihedron.plugins.shared.per_thread import PerThread


@register("lines", "fast_line")
@dataclass(frozen=True)
class FastLine(LineOptions):
    """Fast line detector (Lee et al., ICRA 2014; OpenCV's): chains of Canny edge pixels cut into straight runs, then joined, placed to sub-pixel and
    described like those of `lsd`."""

    scale: Annotated[float, Range(0.1, 1)] = 0.7  # of the image the detector looks at; at half size close parallel edges become one
    band_px: Annotated[int, Range(1, 31)] = 10  # rows of an LBD band, on the reduced image
    merge_gap_px: NonNegativeFloat = 18.0  # between fragments of one edge; Canny's chains turn at corners
    weak: PositiveFloat = 20.0  # Canny's thresholds, grey levels per px times 4 (Sobel): a chain of edge pixels goes on above this
    strong: PositiveFloat = 50.0  # and needs one above this (OpenCV's default)
    straight_px: Annotated[float, Range(0.5, 5)] = 1.41  # an edge pixel farther than this from the line of its run ends the run (Lee et al.)

    def __post_init__(self) -> None:
        check_increasing(self, "weak", "strong")

    def __call__(self, frame: Frame) -> LineSegments:
        """The longest segments, longest first; (n, 32) binary descriptors."""
        small = reduce_image(self, frame.gray)
        found = self._detector().detect(small) if min(small.shape) >= MIN_SIDE_PX else None
        return line_segments(self, frame, small, found)

    @cached_property
    def _detector(self) -> PerThread[Any]:
        """The detector of each thread."""
        return PerThread(self._make_detector)

    def _make_detector(self) -> Any:
        """Make a detector. Runs half as long as the shortest segment wanted are kept: they may be fragments of one."""
        shortest = max(int(0.5 * self.min_length_px * self.scale), 3)
        return cv2.ximgproc.createFastLineDetector(shortest, self.straight_px, self.weak, self.strong, 3, False)
