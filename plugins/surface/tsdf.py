"""A truncated signed distance field."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.registry import register
from trihedron.pipeline.types import Map, Surface
from trihedron.plugins.numerics.surfaces.assembly import free_surface
from trihedron.plugins.numerics.surfaces.painting import painted, vertex_normals
from trihedron.plugins.numerics.surfaces.surface_nets import zero_level
from trihedron.plugins.numerics.surfaces.view_fold import Gathered, VolumeFold


@register("surface", "tsdf")
@dataclass(frozen=True)
class Tsdf(VolumeFold):
    """Everything seen as one dense mesh: signed distances along the rays (Curless and Levoy 1996), weighed by the depth's variance; no planes."""

    def finish(self, state: Gathered, map: Map | None) -> Surface:
        """The zero level of the distances, coloured by the views."""
        views = state.settled(map)
        vertices, triangles = zero_level(self._volume(state, map), self._least_weight)
        colors = painted(vertices, vertex_normals(vertices, triangles), views)
        return free_surface(state, vertices, colors, triangles, state.up(views))
