"""No line segments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, LineSegments


@register("lines", "none")
@dataclass(frozen=True)
class NoLines:
    """A value without rows: what the rest of the system does without lines."""

    descriptor_bytes: Annotated[int, Range(1, 4096)] = 32  # length of the (absent) descriptors, that of binary LBD

    def __call__(self, frame: Frame) -> LineSegments:
        """Zero segments."""
        return LineSegments(frame.index, frame.stamp_ns, np.zeros((0, 2, 2), np.float32), np.zeros((0, self.descriptor_bytes), np.uint8))
