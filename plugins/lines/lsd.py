"""LSD line segments with LBD descriptors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveShare, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, LineSegments
from trihedron.plugins.lines.lsd_kernels import line_support_segments
from trihedron.plugins.lines.segment_completion import LineOptions, line_segments, reduce_image


@register("lines", "lsd")
@dataclass(frozen=True)
class Lsd(LineOptions):
    """Line segment detector (von Gioi et al., PAMI 2010) on a reduced image, fragments merged, placed to sub-pixel on the full image,
    described by LBD (Zhang & Koch, 2013). Segments are directed with the bright side on their right: start and end keep their meaning over time."""

    tolerance_deg: Annotated[float, Range(5, 45)] = 22.5  # between the level lines of a pixel and its segment; as the next two by von Gioi et al.
    quantisation: PositiveFloat = 2.0  # grey levels a gradient may be wrong by
    density: PositiveShare = 0.7  # share of a segment's rectangle that its pixels fill

    def __call__(self, frame: Frame) -> LineSegments:
        """The longest segments, longest first; (n, 32) binary descriptors."""
        small = reduce_image(self, frame.gray)
        found = line_support_segments(small, float(np.radians(self.tolerance_deg)), self.quantisation, self.density)
        return line_segments(self, frame, small, found)
