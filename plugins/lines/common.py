"""Final steps of every detector of line segments: fragments merged, placed on the edge to sub-pixel, directed, and described by LBD."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import cv2
import numpy as np

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveInt, Range
from trihedron.pipeline.core.types import F32, F64, U8, Frame, LineSegments
from trihedron.plugins.lines.common_kernels import Placing, line_band_descriptors, placed_segments

SMALLEST = 8  # px, side of an image a detector is asked to look at; some fail on less


@dataclass(frozen=True)
class StraightEdges:
    """Base of the plugins of `lines`: a plugin finds segments on a reduced image, `_segments` makes LineSegments of them.

    Segments are directed with the bright side on their right: start and end keep their meaning over time."""

    scale: Annotated[float, Range(0.1, 1)] = 0.5  # of the image the detector looks at
    segments: PositiveInt = 150  # most segments kept, the longest
    min_length_px: Annotated[float, Range(4)] = 20.0  # shortest segment kept
    merge_deg: Annotated[float, Range(0, below=45)] = 2.0  # fragments of one edge: difference of direction,
    merge_offset_px: NonNegativeFloat = 1.5  # distance across,
    merge_gap_px: NonNegativeFloat = 12.0  # and along
    border_px: NonNegativeFloat = 4.0  # a segment nearer than this to the image's border all along is the border
    reach_px: Annotated[int, Range(1, 10)] = 3  # searched across the segment for the edge on the full image
    band_px: Annotated[int, Range(1, 31)] = 7  # rows of an LBD band, on the reduced image

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
