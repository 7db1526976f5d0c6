"""The exact plan of a synthetic scene: rooms between walls, and doorways. World frame of the scene, metres, z up.

Walls are the solids of material "wall" that reach the ceiling; one that begins above the floor is a lintel, and what is below it a doorway. Pieces of
furniture are no part of a plan, however high."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.datasets.simulation.room import Room, Solid
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64

LEAST_M2 = 0.5  # of a room


@dataclass(frozen=True)
class Doorway:
    """A gap in a wall: its middle on the floor (2,), the unit direction of the wall (2,), width, heights of bottom and top above
    the floor, metres."""

    middle: F64
    along: F64
    width_m: float
    bottom_m: float
    height_m: float


@dataclass(frozen=True)
class TruePlan:
    """Rooms of a storey as rings of corners, each ring (n, 2) anticlockwise, followed by the rings of holes; doorways; windows between rooms; heights
    of floor and ceiling."""

    rooms: list[list[F64]]
    doorways: list[Doorway]
    windows: list[Doorway]
    floor_m: float
    ceiling_m: float


def plans_of(room: Room) -> list[TruePlan]:
    """Make the plan of each storey of a scene with upright walls, from the lowest."""
    return [_plan(room, floor, ceiling) for floor, ceiling in room.storeys_m]


def _plan(room: Room, floor_m: float, ceiling_m: float) -> TruePlan:
    import shapely

    walls = [solid for solid in room.solids if _is_wall(solid, ceiling_m)]
    inside = shapely.difference(_footprint(room), shapely.union_all([shapely.Polygon(_outline(wall)).buffer(1e-6) for wall in walls]))
    parts = [part for part in getattr(inside, "geoms", [inside]) if part.area > LEAST_M2]
    oriented = [shapely.geometry.polygon.orient(part.simplify(1e-4)) for part in parts]
    rooms = [[np.array(ring.coords)[:-1] for ring in (part.exterior, *part.interiors)] for part in oriented]
    gaps = [_doorway(wall, room, floor_m) for wall in walls if _bottom(wall) > floor_m]
    return TruePlan(rooms, [gap for gap in gaps if gap.bottom_m == 0.0], [gap for gap in gaps if gap.bottom_m > 0.0], floor_m, ceiling_m)


def _is_wall(solid: Solid, ceiling_m: float) -> bool:
    return all(face.material == "wall" for face in solid.faces) and abs(float(solid.centre[2] + solid.half[2]) - ceiling_m) < 1e-9


def _bottom(solid: Solid) -> float:
    return float(solid.centre[2] - solid.half[2])


def _outline(solid: Solid) -> F64:
    """Return the corners (4, 2) of a box on the plan."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * solid.half[:2]
    return np.asarray(matmul(corners, solid.R_world_solid[:2, :2].T) + solid.centre[:2])


def _doorway(lintel: Solid, room: Room, floor_m: float) -> Doorway:
    """Make the gap below a lintel, which begins on the parapet of the same outline, if there is one."""
    long = int(np.argmax(lintel.half[:2]))
    below = [solid for solid in room.solids if np.allclose(solid.centre[:2], lintel.centre[:2]) and np.allclose(solid.half[:2], lintel.half[:2])]
    tops = [float(solid.centre[2] + solid.half[2]) - floor_m for solid in below]
    parapets = [top for top in tops if 0.0 < top < _bottom(lintel) - floor_m]
    along = lintel.R_world_solid[:2, long]
    return Doorway(lintel.centre[:2], along, 2.0 * float(lintel.half[long]), max(parapets, default=0.0), _bottom(lintel) - floor_m)


def _footprint(room: Room) -> object:
    """Return the polygon that the room's own upright planes bound."""
    import shapely

    polygon = shapely.box(-1e3, -1e3, 1e3, 1e3)
    for normal, d in ((plane[:2], plane[3]) for plane in room.planes if abs(plane[2]) < 1e-9):
        foot, along = -d * normal, np.array([-normal[1], normal[0]])
        far = np.array([foot - 1e4 * along, foot + 1e4 * along])
        polygon = polygon.intersection(shapely.Polygon(np.concatenate([far, far[::-1] + 1e4 * normal])))
    return polygon
