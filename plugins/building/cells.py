"""Inside and outside by a minimum cut."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Bool, Building, Frame, Map, Planes, Pose, Rotation
from trihedron.plugins.building.cell_complex import Cells
from trihedron.plugins.building.edits import apply_edits
from trihedron.plugins.building.layout import AtlantaOptions, atlanta_directions, plan_building
from trihedron.plugins.building.views import BuildingState, add_view, empty_state, preview_state

SCALE = 10_000  # capacities are whole numbers


@register("building", "cells")
@dataclass(frozen=True)
class CellComplex(AtlantaOptions):
    """Label the cells of `atlanta_layout` together (Ochmann, Vock, Wessel, Klein, Computers & Graphics 2016, with two labels; the cut of
    Boykov, Jolly, ICCV 2001): a cell costs the area that contradicts its label, a border between inside and outside its length without a wall."""

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
        """Return the cells on the source's side of the cut: source - cells - sink, capacities by free and not free area."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import breadth_first_order, maximum_flow

        n = len(cells.polygons)
        area = np.array([polygon.area for polygon in cells.polygons])
        first, second, tall, length = np.array(cells.edges).reshape(-1, 4).T
        numbers, border = np.arange(n), self.open_border_m * length * (1.0 - tall)
        rows = np.concatenate([np.full(n, n), numbers, first, second]).astype(int)
        columns = np.concatenate([numbers, np.full(n, n + 1), second, first]).astype(int)
        capacity = np.concatenate([area * cells.free, area * (1.0 - cells.free), border, border])
        graph = coo_matrix((np.rint(SCALE * capacity).astype(np.int32), (rows, columns)), shape=(n + 2, n + 2)).tocsr()
        residual = graph - maximum_flow(graph, n, n + 1).flow
        residual.data = np.maximum(residual.data, 0)
        residual.eliminate_zeros()
        inside = np.zeros(n + 2, np.bool_)
        inside[breadth_first_order(residual, n, return_predecessors=False)] = True
        return np.asarray(inside[:n] & (cells.free > 0.0), np.bool_)
