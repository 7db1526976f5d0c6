"""No 3D lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import LineSegments, Segments


@register("segments", "none")
@dataclass(frozen=True)
class NoSegments:
    """A value without rows, whatever lines were found: what the rest of the system does without them."""

    def __call__(self, lines: LineSegments) -> Segments:
        """Zero segments with descriptors of the lines' length."""
        return Segments(
            index=lines.index,
            stamp_ns=lines.stamp_ns,
            endpoints_px=np.zeros((0, 2, 2), np.float32),
            endpoints_m=np.zeros((0, 2, 3), np.float32),
            covariance_m2=np.zeros((0, 2, 3, 3), np.float32),
            descriptors=np.zeros((0, lines.descriptors.shape[1]), np.uint8),
        )
