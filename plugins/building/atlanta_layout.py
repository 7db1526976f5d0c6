"""Rooms whose walls are upright and at any angle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64
from trihedron.plugins.building.common import Evidence, Storey, slanted_directions
from trihedron.plugins.building.common_layout import AXES, Layout


@register("building", "atlanta_layout")
@dataclass(frozen=True)
class AtlantaLayout(Layout):
    """Extend `manhattan_layout` by further directions of walls: the peaks of the upright regions' normals about the vertical (Schindler, Dellaert,
    CVPR 2004, "Atlanta world"). An edge along none of the axes is turned to its own points."""

    apart_deg: Annotated[float, Range(2, 45)] = 6.0  # between directions
    least_m2: PositiveFloat = 1.0  # of tall points of a direction

    def _directions(self, evidence: Evidence, storey: Storey) -> F64:
        """Return the axes and the other peaks."""
        more = np.radians(slanted_directions(evidence, storey, self.apart_deg, self.least_m2))
        one = np.stack([np.cos(more), np.sin(more)], axis=1)
        return np.concatenate([AXES, one, -one])
