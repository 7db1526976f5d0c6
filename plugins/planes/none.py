"""No planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Normals, Planes


@register("planes", "none")
@dataclass(frozen=True)
class NoPlanes:
    """A value without rows and all labels 0: what the rest of the system does without planes."""

    samples: PositiveInt = 48  # points of the (absent) regions

    def __call__(self, normals: Normals) -> Planes:
        """Zero planes."""
        return Planes(
            index=normals.index,
            stamp_ns=normals.stamp_ns,
            coefficients=np.zeros((0, 4)),
            covariance=np.zeros((0, 3, 3)),
            moments=np.zeros((0, 4, 4)),
            pixels=np.zeros(0, np.int32),
            samples_m=np.zeros((0, self.samples, 3), np.float32),
            labels=np.zeros(normals.normals.shape[:2], np.uint8),
            stride=normals.stride,
        )
