"""No normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals


@register("normals", "none")
@dataclass(frozen=True)
class NoNormals:
    """A grid of NaN: what the rest of the system does without normals (and so without planes found from them)."""

    stride: Annotated[int, Range(1, 8)] = 2  # px between cells of the grid

    def __call__(self, frame: Frame) -> Normals:
        """Return no normals."""
        h, w = (-(-side // self.stride) for side in frame.depth_m.shape)
        return Normals(frame.index, frame.stamp_ns, np.full((h, w, 3), np.nan, np.float32), self.stride)
