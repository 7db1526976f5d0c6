"""Rooms whose walls are at right angles."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.plugins.building.common_layout import Layout


@register("building", "manhattan_layout")
@dataclass(frozen=True)
class ManhattanLayout(Layout):
    """Cut the plan along the faces of walls in the two horizontal Manhattan axes; what rays passed is inside, what tall faces part are two rooms."""
