"""What every detector of line segments ends in: fragments merged, placed on the edge to sub-pixel, directed, and described by LBD."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from trihedron.pipeline.core.types import F32, F64, U8, Frame, LineSegments
from trihedron.plugins.lines.common_kernels import Placing, line_band_descriptors, placed_segments

SMALLEST = 8  # px, side of an image a detector is asked to look at; some fail on less


@dataclass(frozen=True)
class StraightEdges:
    """Base of the plugins of `lines`: a plugin finds segments on a reduced image, `_segments` makes LineSegments of them.

    Segments are directed with the bright side on their right: start and end keep their meaning over time."""

    scale: float = 0.5  # of the image the detector looks at
    segments: int = 150  # most segments kept, the longest
    min_length_px: float = 20.0  # shortest segment kept
    merge_deg: float = 2.0  # fragments of one edge: difference of direction,
    merge_offset_px: float = 1.5  # distance across,
    merge_gap_px: float = 12.0  # and along
    border_px: float = 4.0  # a segment nearer than this to the image's border all along is the border
    reach_px: int = 3  # searched across the segment for the edge on the full image
    band_px: int = 7  # rows of an LBD band, on the reduced image

    def __post_init__(self) -> None:
        if not 0.1 <= self.scale <= 1.0:
            raise ValueError("scale: must be 0.1 to 1")
        if self.segments < 1 or self.min_length_px < 4.0:
            raise ValueError("segments, min_length_px: must be at least 1 and 4 px")
        if not 0.0 <= self.merge_deg < 45.0 or self.merge_offset_px < 0.0 or self.merge_gap_px < 0.0:
            raise ValueError("merge_deg, merge_offset_px, merge_gap_px: must not be negative; merge_deg below 45")
        if self.border_px < 0.0:
            raise ValueError("border_px: must not be negative")
        if not 1 <= self.reach_px <= 10 or not 1 <= self.band_px <= 31:
            raise ValueError("reach_px, band_px: must be 1 to 10 and 1 to 31")

    def _reduced(self, gray: U8) -> U8:
        """The image at `scale`."""
        if self.scale == 1.0:
            return gray
        size = max(round(gray.shape[1] * self.scale), 1), max(round(gray.shape[0] * self.scale), 1)
        return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))

    def _segments(self, frame: Frame, small: U8, found: F32 | F64 | None) -> LineSegments:
        """The longest segments, longest first, with (n, 32) binary descriptors, of those `found` on the reduced image: n × 4 numbers in any shape."""
        lines = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)
        endpoints = placed_segments(frame.gray, lines, self.scale, self._placing, self.segments)
        return LineSegments(index=frame.index, stamp_ns=frame.stamp_ns, endpoints_px=endpoints, descriptors=self._described(small, endpoints))

    @cached_property
    def _placing(self) -> Placing:
        angle, least_px, border_px = math.radians(self.merge_deg), float(self.min_length_px), float(self.border_px)
        return Placing(angle, float(self.merge_offset_px), float(self.merge_gap_px), least_px, border_px, self.reach_px)

    def _described(self, small: U8, endpoints: F32) -> U8:
        return line_band_descriptors(small, endpoints, self.scale, self.band_px, 2.0)

    @cached_property
    def _local(self) -> threading.local:
        """Holds each thread's detector."""
        return threading.local()
