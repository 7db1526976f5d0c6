"""Final steps of every line detector: merge fragments, place segments on the edge to sub-pixel, direct them, and describe them by LBD."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveInt, Range
from trihedron.pipeline.core.types import F32, F64, U8, Frame, LineSegments
from trihedron.plugins.lines.lbd_kernels import line_band_descriptors
from trihedron.plugins.lines.segment_completion_kernels import SegmentRules, place_segments

MIN_SIDE_PX = 8  # px, side of an image a detector is asked to look at; some fail on less


@dataclass(frozen=True)
class LineOptions:
    """Options of every detector: a plugin finds segments on a reduced image, `line_segments` makes the value of them."""

    scale: Annotated[float, Range(0.1, 1)] = 0.5  # of the image the detector looks at
    segments: PositiveInt = 150  # most segments kept, the longest
    min_length_px: Annotated[float, Range(4)] = 20.0  # shortest segment kept
    merge_deg: Annotated[float, Range(0, below=45)] = 2.0  # fragments of one edge: difference of direction,
    merge_offset_px: NonNegativeFloat = 1.5  # distance across,
    merge_gap_px: NonNegativeFloat = 12.0  # and along
    border_px: NonNegativeFloat = 4.0  # a segment nearer than this to the image's border all along is the border
    reach_px: Annotated[int, Range(1, 10)] = 3  # searched across the segment for the edge on the full image
    band_px: Annotated[int, Range(1, 31)] = 7  # rows of an LBD band, on the reduced image


def reduce_image(options: LineOptions, gray: U8) -> U8:
    """Return the image at `scale`."""
    if options.scale == 1.0:
        return gray
    size = max(round(gray.shape[1] * options.scale), 1), max(round(gray.shape[0] * options.scale), 1)
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))


def line_segments(options: LineOptions, frame: Frame, small: U8, found: F32 | F64 | None) -> LineSegments:
    """Return the longest segments, longest first, with (n, 32) binary descriptors, of those `found` on the reduced image: n × 4 numbers in any shape.

    Segments are directed with the bright side on their right: start and end keep their meaning over time."""
    lines = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)
    rules = SegmentRules(
        angle=math.radians(options.merge_deg),
        offset_px=float(options.merge_offset_px),
        gap_px=float(options.merge_gap_px),
        least_px=float(options.min_length_px),
        border_px=float(options.border_px),
        reach_px=options.reach_px,
    )
    endpoints = place_segments(frame.gray, lines, options.scale, rules, options.segments)
    descriptors = line_band_descriptors(small, endpoints, options.scale, options.band_px, 2.0)
    return LineSegments(index=frame.index, stamp_ns=frame.stamp_ns, endpoints_px=endpoints, descriptors=descriptors)
