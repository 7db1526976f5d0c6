"""A truncated signed distance field."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Map, Planes, Pose, Rotation, Surface
from trihedron.plugins.surface.colored_mesh import colored_surface
from trihedron.plugins.surface.fused_volume import FusedViews, VolumeOptions, final_mesh, fuse_view, volume_preview
from trihedron.plugins.surface.retained_views import add_view


@register("surface", "tsdf")
@dataclass(frozen=True)
class Tsdf(VolumeOptions):
    """Everything seen as one dense mesh (Curless and Levoy 1996), each reading weighed by its depth's variance; no planes."""

    def start(self) -> FusedViews:
        """Return an empty state."""
        return FusedViews()

    def add(self, state: FusedViews, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> FusedViews:
        """Retain the frame if it was tracked and shows something new, and fuse it."""
        return fuse_view(self, state, add_view(self, state, frame, planes, rotation, pose, map))

    def preview(self, state: FusedViews) -> Surface:
        """Return the mesh so far, without planes: for viewers."""
        return volume_preview(self, state)

    def finish(self, state: FusedViews, map: Map | None) -> Surface:
        """The zero level of the distances, coloured by the views."""
        return colored_surface(state, map, *final_mesh(self, state, map))
