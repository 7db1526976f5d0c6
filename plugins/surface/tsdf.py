"""A truncated signed distance field."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Map, Planes, Pose, Rotation, Surface
from trihedron.plugins.surface.common import add_view, coloured
from trihedron.plugins.surface.common_iso_surface import Fused, VolumeOptions, final_mesh, fuse_view, volume_preview


@register("surface", "tsdf")
@dataclass(frozen=True)
class Tsdf(VolumeOptions):
    """Everything seen as one dense mesh (Curless and Levoy 1996), each reading weighed by its depth's variance; no planes."""

    def start(self) -> Fused:
        """Return an empty state."""
        return Fused()

    def add(self, state: Fused, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> Fused:
        """Retain the frame if it was tracked and shows something new, and fuse it."""
        return fuse_view(self, state, add_view(self, state, frame, planes, rotation, pose, map))

    def preview(self, state: Fused) -> Surface:
        """Return the mesh so far, without planes: for viewers."""
        return volume_preview(self, state)

    def finish(self, state: Fused, map: Map | None) -> Surface:
        """The zero level of the distances, coloured by the views."""
        return coloured(state, map, *final_mesh(self, state, map))
