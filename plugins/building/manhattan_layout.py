"""Rooms whose walls are at right angles."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.plugins.building.common import Evidence, Storey, slanted_directions
from trihedron.plugins.building.common_layout import Layout

APART_DEG, LEAST_M2 = 6.0, 3.0  # from the axes, and area of tall points of all views, for which a slanted wall is mentioned


@register("building", "manhattan_layout")
@dataclass(frozen=True)
class ManhattanLayout(Layout):
    """Cut the plan along the faces of walls in the two horizontal Manhattan axes; what rays passed is inside, what tall faces part are two rooms."""

    def _remark(self, evidence: Evidence, storey: Storey) -> str:
        """Name walls along neither axis."""
        if not len(slanted_directions(evidence, storey, APART_DEG, LEAST_M2)):
            return ""
        return "walls at other than right angles were seen, which building=atlanta_layout lays out"
