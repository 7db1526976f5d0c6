"""Discs instead of a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import AcuteDeg, PositiveFloat, PositiveInt, Range, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Map, Planes, Pose, Rotation, Surface
from trihedron.plugins.surface.colored_mesh import map_planes, number_planes, textured_surface
from trihedron.plugins.surface.observed_planes import observed_planes
from trihedron.plugins.surface.retained_views import RetainedViews, ViewOptions, add_view
from trihedron.plugins.surface.superpixel_surfels import cut_superpixels, discs, fuse_surfels, transform_surfels


@register("surface", "surfels")
@dataclass(frozen=True)
class Surfels(ViewOptions):
    """Superpixels of the views fused to discs (Wang, Gao, Shen, ICRA 2019), but coarse where the view is planar: a wall needs few."""

    side_px: Annotated[int, Range(2)] = 6  # of a superpixel, in the reduced view
    coarse_px: Annotated[int, Range(2)] = 20  # in planar regions
    angle_deg: AcuteDeg = 30.0  # between the normals of superpixels of one surfel
    least: PositiveInt = 3  # views that must agree on a surfel
    region_deg: AcuteDeg = 10.0  # between a region and the plane it belongs to
    region_m: PositiveFloat = 0.05  # of its points from it, on average
    texel_m: Annotated[float, Range(0.001)] = 0.015  # of the picture of the planes

    def __post_init__(self) -> None:
        check_increasing(self, "side_px", "coarse_px")

    def start(self) -> RetainedViews:
        """Return an empty state."""
        return RetainedViews()

    def add(self, state: RetainedViews, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> RetainedViews:
        """Retain the frame if it was tracked and shows something new, and cut it."""
        view = add_view(self, state, frame, planes, rotation, pose, map)
        if view is not None:
            state.surfels.append(cut_superpixels(view, self.side_px, self.coarse_px))
        return state

    def finish(self, state: RetainedViews, map: Map | None) -> Surface:
        """The surfels of all views at their final poses, as discs of six corners."""
        views = state.views_at_final_poses(map)
        ids, known = map_planes(map)
        found = observed_planes(views, known, self.region_deg, self.region_m)
        settled = [surfels for view, surfels in zip(state.views, state.surfels) if view.final_pose(map) is not None]
        placed = [transform_surfels(surfels, T) for surfels, (_, T) in zip(settled, views)]
        for surfels, planes in zip(placed, found.regions):
            surfels[:, 11] = np.append(planes, -1)[surfels[:, 11].astype(int)]
        agreed = fuse_surfels(placed, float(np.cos(np.radians(self.angle_deg))))
        agreed = agreed[agreed[:, 12] >= self.least]
        vertices, triangles = discs(agreed)
        labels = np.repeat(agreed[:, 11].astype(np.int32), len(triangles) // max(len(agreed), 1))
        return textured_surface(
            state, map, vertices, triangles, labels, found.planes, number_planes(ids, len(found.planes), map), [], self.texel_m
        )  # fmt: skip
