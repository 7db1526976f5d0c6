"""Planes as polygons."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Surface
from trihedron.plugins.surface.common import Gathered
from trihedron.plugins.surface.common_planar import PlanarFold


@register("surface", "planar_polygon")
@dataclass(frozen=True)
class PlanarPolygon(PlanarFold):
    """Planes alone, as polygons with holes that meet along the lines where their planes intersect; triangles by constrained Delaunay."""

    def finish(self, state: Gathered, map: Map | None) -> Surface:
        """The mesh at the final poses, coloured and pictured by the views."""
        return self._surface(state, map, rest=False)
