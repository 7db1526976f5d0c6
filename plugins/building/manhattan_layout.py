"""Rooms whose walls are at right angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Building, Map
from trihedron.plugins.building.common import Gathered, LayoutFold, evidence_of, faces_of, free_space, nothing, storeys_of
from trihedron.plugins.building.common_layout import FREE_SHARE, StoreyPlan, assembled, cells_of, in_storey, openings_of, rooms_of, walls_of


@register("building", "manhattan_layout")
@dataclass(frozen=True)
class ManhattanLayout(LayoutFold):
    """Cut the plan along the faces of walls in the two horizontal Manhattan axes; what rays passed is inside, what tall faces part are two rooms."""

    def finish(self, state: Gathered, map: Map | None) -> Building:
        """Make the plan at the final poses."""
        evidence = evidence_of(state, map)
        if evidence is None:
            return nothing(state, "no plane was seen")
        storeys, plans = storeys_of(evidence), []
        axes = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
        for number, storey in enumerate(storeys):
            here = in_storey(evidence, storeys, number)
            faces, space = faces_of(here, storey, axes, self.least_wall_m), free_space(here, storey)
            cells = cells_of(faces, space)
            rooms = rooms_of(cells, cells.free >= FREE_SHARE, faces, here, space, storey, self.least_room_m2)
            walls = walls_of(rooms, faces)
            plans.append(StoreyPlan(storey, rooms, walls, openings_of(walls, rooms, faces, here, space, storey), faces))
        return assembled(state, evidence, plans, map)
