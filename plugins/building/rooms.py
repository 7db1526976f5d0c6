"""Rooms: inside cells that no tall face parts.

Mura, Mattausch, Jaspe Villanueva, Gobbetti, Pajarola, Computers & Graphics 2014, with free space in the place of scan positions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trihedron.pipeline.core.types import F64, Bool
from trihedron.plugins.building.cell_complex import Cells, components
from trihedron.plugins.building.edges import Edge, edges_of_ring, end_at_readings, fit_edge, intersect_edges, make_relative
from trihedron.plugins.building.evidence import Evidence
from trihedron.plugins.building.faces import Face
from trihedron.plugins.building.free_space import CELL_M, FreeSpace
from trihedron.plugins.building.levels import Storey

SLIT_M = 0.03  # half of the width of what is no part of a room


@dataclass
class RoomPlan:
    """A room: its loops of edges, the outer one first."""

    loops: list[list[Edge]]
    polygon: Any
    doubts: list[tuple[float, float]] = field(default_factory=list)  # `doubts_of`


def rooms_of(cells: Cells, inside: Bool, faces: list[Face], evidence: Evidence, space: FreeSpace, storey: Storey, least_m2: float) -> list[RoomPlan]:
    """Make the polygons of rooms of which at least `least_m2` of floor or free space was seen, with their edges fitted."""
    import shapely
    from shapely.ops import unary_union

    found = []
    for group in components(cells, inside):
        whole = shapely.simplify(unary_union([cells.polygons[k] for k in group]), 1e-4)
        for polygon in whole.geoms if whole.geom_type == "MultiPolygon" else [whole]:
            polygon = _remove_slits(polygon)
            if polygon is None or polygon.area < least_m2 or not _is_visited(polygon, evidence, space):
                continue
            polygon = shapely.geometry.polygon.orient(polygon)
            rings = (polygon.exterior, *polygon.interiors)
            loops = [edges_of_ring(ring, faces) for ring in rings]
            for edge in (edge for loop in loops for edge in loop):
                fit_edge(edge, evidence, storey)
            loops = [end_at_readings(loop, faces) for loop in loops]
            for loop in loops:
                intersect_edges(loop)
            make_relative([edge for loop in loops for edge in loop])
            found.append(RoomPlan(loops, polygon))
    return found


def _remove_slits(polygon: Any) -> Any:
    """Return the polygon without slits narrower than twice SLIT_M, or None."""
    slim = polygon.buffer(-SLIT_M, join_style="mitre").buffer(SLIT_M, join_style="mitre")
    if slim.geom_type == "MultiPolygon":
        slim = max(slim.geoms, key=lambda part: part.area)
    slim = slim.simplify(1e-3)
    return None if slim.is_empty else slim


def _is_visited(polygon: Any, evidence: Evidence, space: FreeSpace) -> bool:
    """Say if a camera was in it, or some of its floor was seen."""
    import shapely

    eyes = evidence.eyes
    if shapely.contains_xy(polygon, eyes[:, 0], eyes[:, 1]).any():
        return True
    row, column = np.nonzero(space.floor)
    cells = space.origin + (np.stack([column, row], axis=1) + 0.5) * CELL_M
    return float(shapely.contains_xy(polygon, cells[:, 0], cells[:, 1]).sum()) * CELL_M**2 >= 0.5


def room_at(rooms: list[RoomPlan], point: F64) -> int:
    """Return the room that holds a point (2,), -1 for none."""
    import shapely

    return next((k for k, room in enumerate(rooms) if shapely.contains_xy(room.polygon, *point)), -1)
