"""Planes as polygons, the rest dense."""

from __future__ import annotations

from dataclasses import dataclass

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Map, Planes, Pose, Rotation, Surface
from trihedron.plugins.surface.fused_volume import FusedViews, fuse_view, volume_preview
from trihedron.plugins.surface.planar_mesh import planar_surface
from trihedron.plugins.surface.planar_segmentation import PlanarOptions
from trihedron.plugins.surface.retained_views import add_view


@register("surface", "planar_tsdf")
@dataclass(frozen=True)
class PlanarTsdf(PlanarOptions):
    """Planes as polygons, and everything else as a distance field shows it, joined to them vertex by vertex."""

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
        """The mesh at the final poses, coloured and textured by the views."""
        return planar_surface(self, state, map, rest=True)
