"""Planes as polygons, the rest dense."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Surface
from trihedron.plugins.surface.common import Gathered
from trihedron.plugins.surface.common_planar import PlanarFold


@register("surface", "planar_tsdf")
@dataclass(frozen=True)
class PlanarTsdf(PlanarFold):
    """Planes as polygons, and everything else as a distance field shows it, joined to them vertex by vertex."""

    def finish(self, state: Gathered, map: Map | None) -> Surface:
        """The mesh at the final poses, coloured and pictured by the views."""
        return self._surface(state, map, rest=True)
