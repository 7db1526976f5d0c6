"""Inside and outside by a minimum cut."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Bool, Building, Frame, Map, Planes, Pose, Rotation
from trihedron.plugins.building.cell_complex import Cells, cut_cells
from trihedron.plugins.building.edits import apply_edits
from trihedron.plugins.building.layout import AtlantaOptions, atlanta_directions, plan_building
from trihedron.plugins.building.views import BuildingState, add_view, empty_state, preview_state


@register("building", "cells")
@dataclass(frozen=True)
class CellComplex(AtlantaOptions):
    """Label the cells of `atlanta_layout` as Ochmann, Vock, Wessel, Klein, Computers & Graphics 2016, do, with two labels: what no ray passed counts
    against a cell as much as what rays passed counts for it."""

    open_border_m: PositiveFloat = 0.05  # area in m² that a metre of border without a wall costs

    def start(self) -> BuildingState:
        """Return an empty state, with the corrections by hand."""
        return empty_state(self)

    def add(self, state: BuildingState, frame: Frame, planes: Planes, rotation: Rotation | None, pose: Pose, map: Map | None) -> BuildingState:
        """Retain the frame if it became a keyframe."""
        return add_view(self, state, frame, planes, rotation, pose, map)

    def preview(self, state: BuildingState) -> Building:
        """Return the plan so far of a few views, at their poses as they are now."""
        return self.finish(preview_state(state), state.map)

    def finish(self, state: BuildingState, map: Map | None) -> Building:
        """Return the plan at the final poses."""
        return apply_edits(plan_building(self, state, map, partial(atlanta_directions, self), self._inside), state.edits)

    def _inside(self, cells: Cells) -> Bool:
        """Return the cells (n,) on the source's side of the cut that a ray passed."""
        return cut_cells(cells, self.open_border_m, 1.0) & (cells.free > 0.0)
