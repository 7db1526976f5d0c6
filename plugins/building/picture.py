"""The picture of a building in notebooks: rooms, walls and the openings in them, from above."""

from __future__ import annotations

import cv2

from trihedron.pipeline.core.pictures import canvas_round, picture_of
from trihedron.pipeline.core.types import U8, Building
from trihedron.plugins.building.geometry import quad, rings_of, wall_pieces

ROOM, WALL, OPENING = (226, 236, 247), (60, 60, 60), (240, 150, 40)
Y_DOWN = (1.0, -1.0)


@picture_of.register
def picture_of_building(building: Building) -> U8 | None:
    """Draw all storeys upon each other; None where there is neither room nor wall."""
    rings = [[ring * Y_DOWN for ring in rings_of(building, room)] for room in range(len(building.areas_m2))]
    walls = [piece.corners * Y_DOWN for wall in range(len(building.walls_m)) for piece in wall_pieces(building, wall)]
    openings = [quad(building, int(wall), *span) * Y_DOWN for wall, span in zip(building.opening_walls, building.spans_m)]
    pieces = [*(ring for room in rings for ring in room), *walls]
    if not pieces:
        return None
    image, place = canvas_round(pieces)
    for room in rings:
        cv2.fillPoly(image, [place(ring) for ring in room], ROOM)
    for corners, color in [*((wall, WALL) for wall in walls), *((opening, OPENING) for opening in openings)]:
        cv2.fillPoly(image, [place(corners)], color)
        cv2.polylines(image, [place(corners)], True, color, 2)
    return image
