"""A truncated signed distance field."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Surface
from trihedron.plugins.surface.common import Gathered, VolumeFold, coloured


@register("surface", "tsdf")
@dataclass(frozen=True)
class Tsdf(VolumeFold):
    """Everything seen as one dense mesh (Curless and Levoy 1996), each reading weighed by its depth's variance; no planes."""

    def finish(self, state: Gathered, map: Map | None) -> Surface:
        """The zero level of the distances, coloured by the views."""
        return coloured(state, map, *self._mesh(state, map))
