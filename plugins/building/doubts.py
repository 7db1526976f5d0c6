"""Doubts about the area of a room, besides where its walls are: what may be furniture or a wall, and what no view shows."""

from __future__ import annotations

from typing import Any

import numpy as np

from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.plan_areas import OPEN_M, OPEN_PROBABILITY
from trihedron.pipeline.core.types import F64
from trihedron.plugins.building.edges import Edge
from trihedron.plugins.building.free_space import CELL_M, FreeSpace
from trihedron.plugins.building.rooms import RoomPlan
from trihedron.plugins.building.tall_furniture import Doubt

ON_LINE_M = 0.05
LEAST_M2 = 0.02  # what would change an area by less is left out
BESIDE_WALLS_M = 0.15  # where rays end before their readings
SOLID_PROBABILITY = 0.2  # that what no view shows within a room is none of it


def doubts_of(room: RoomPlan, found: list[Doubt], space: FreeSpace) -> list[tuple[float, float]]:
    """Return by how much the area of a room would change, m², and with which probability, for each alternative to its plan."""
    out = []
    edges = [edge for loop in room.loops for edge in loop]
    for doubt in found:
        if doubt.wall_probability >= 0.5:
            change = doubt.depth_m * sum(_overlap(doubt, edge) for edge in edges if edge.face is not None)
            out.append((change, 1.0 - doubt.wall_probability))
        else:
            out.append((-_footprint(doubt).intersection(room.polygon).area, doubt.wall_probability))
    out += [(OPEN_M * float(norm(edge.end - edge.begin)), OPEN_PROBABILITY) for edge in edges if edge.face is None]
    out.append((-_unseen_m2(room.polygon, space), SOLID_PROBABILITY))
    return [(change, probability) for change, probability in out if abs(change) >= LEAST_M2]


def _overlap(doubt: Doubt, edge: Edge) -> float:
    """Return the length of a stretch that lies on an edge."""
    if float(matmul(doubt.normal, edge.normal)) < 0.999 or abs(float(matmul(doubt.ends[0], edge.normal)) - edge.offset_m) > ON_LINE_M:
        return 0.0
    a, b = np.sort(matmul(doubt.ends, edge.along))
    begin, end = edge.span
    return max(float(min(b, end) - max(a, begin)), 0.0)


def _footprint(doubt: Doubt) -> Any:
    """Return the polygon between a stretch and the wall behind it."""
    import shapely

    back = doubt.ends - doubt.depth_m * doubt.normal
    return shapely.Polygon(np.concatenate([doubt.ends, back[::-1]]))


def _unseen_m2(polygon: Any, space: FreeSpace) -> float:
    """Return the area within a room, away from its walls, that no ray passed and no known furniture covers."""
    import shapely

    inner = polygon.buffer(-BESIDE_WALLS_M)
    if inner.is_empty:
        return 0.0
    x0, y0, x1, y1 = inner.bounds
    x, y = np.meshgrid(np.arange(x0 + CELL_M / 2.0, x1, CELL_M), np.arange(y0 + CELL_M / 2.0, y1, CELL_M))
    places: F64 = np.stack([x, y], axis=-1).reshape(-1, 2)
    places = places[shapely.contains_xy(inner, places[:, 0], places[:, 1])]
    return float((~space.within(places)).sum()) * CELL_M**2
