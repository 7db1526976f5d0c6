"""No line segments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, LineSegments


@register("lines", "none")
@dataclass(frozen=True)
class NoLines:
    """A value without rows: what the rest of the system does without lines."""

    descriptor_bytes: int = 32  # length of the (absent) descriptors, that of binary LBD

    def __post_init__(self) -> None:
        if not 1 <= self.descriptor_bytes <= 4096:
            raise ValueError("descriptor_bytes: must be 1 to 4096")

    def __call__(self, frame: Frame) -> LineSegments:
        """Zero segments."""
        return LineSegments(frame.index, frame.stamp_ns, np.zeros((0, 2, 2), np.float32), np.zeros((0, self.descriptor_bytes), np.uint8))
