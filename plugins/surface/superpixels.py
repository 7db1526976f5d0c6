"""Discs of superpixels, everywhere of one size."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import AcuteDeg, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Map, Planes, Pose, Rotation, Surface
from trihedron.plugins.surface.colored_mesh import colored_surface
from trihedron.plugins.surface.retained_views import RetainedViews, ViewOptions, add_view
from trihedron.plugins.surface.superpixel_surfels import cut_superpixels, discs, fuse_surfels, transform_surfels


@register("surface", "superpixels")
@dataclass(frozen=True)
class Superpixels(ViewOptions):
    """Superpixels of the views fused to discs that hang on the keyframes (Wang, Gao, Shen, ICRA 2019; the paper's "SPFu"). No plane takes part, which
    is the difference from `surfels`."""

    side_px: Annotated[int, Range(2)] = 8  # of a superpixel, in the reduced view
    angle_deg: AcuteDeg = 30.0  # between the normals of superpixels of one surfel
    least: PositiveInt = 3  # views that must agree on a surfel

    def start(self) -> RetainedViews:
        """Return an empty state."""
        return RetainedViews()

    def add(self, state: RetainedViews, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> RetainedViews:
        """Retain the frame if it was tracked and shows something new, and cut it, as if it had no planes."""
        view = add_view(self, state, frame, planes, rotation, pose, map)
        if view is not None:
            state.surfels.append(cut_superpixels(replace(view, labels=np.zeros_like(view.labels)), self.side_px, self.side_px))
        return state

    def finish(self, state: RetainedViews, map: Map | None) -> Surface:
        """The surfels of all views at their final poses, as discs of six corners."""
        placed = [transform_surfels(surfels, T) for view, surfels in zip(state.views, state.surfels) if (T := view.final_pose(map)) is not None]
        agreed = fuse_surfels(placed, float(np.cos(np.radians(self.angle_deg))))
        return colored_surface(state, map, *discs(agreed[agreed[:, 12] >= self.least]))
