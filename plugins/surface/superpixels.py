"""Discs of superpixels, everywhere of one size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map, Surface
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.surface.common import Gathered, ViewFold, coloured
from trihedron.plugins.surface.common_superpixels import discs, fused, moved, superpixels


@register("surface", "superpixels")
@dataclass(frozen=True)
class Superpixels(ViewFold):
    """Superpixels of the views fused to discs that hang on the keyframes (Wang, Gao, Shen, ICRA 2019; the paper's "SPFu"). No plane takes part, which
    is the difference from `surfels`."""

    side_px: int = 8  # of a superpixel, in the reduced view
    angle_deg: float = 30.0  # between the normals of superpixels of one surfel
    least: int = 3  # views that must agree on a surfel

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.side_px < 2 or not 0.0 < self.angle_deg < 90.0 or self.least < 1:
            raise ValueError("side_px, angle_deg, least: at least 2, an angle within 0 … 90, at least 1")

    def _kept(self, state: Gathered, view: KeyframeView) -> None:
        """Cut it, as if it had no planes."""
        state.surfels.append(superpixels(replace(view, labels=np.zeros_like(view.labels)), self.side_px, self.side_px))

    def finish(self, state: Gathered, map: Map | None) -> Surface:
        """The surfels of all views at their final poses, as discs of six corners."""
        placed = [moved(surfels, T) for view, surfels in zip(state.views, state.surfels) if (T := view.settled(map)) is not None]
        agreed = fused(placed, float(np.cos(np.radians(self.angle_deg))))
        return coloured(state, map, *discs(agreed[agreed[:, 12] >= self.least]))
