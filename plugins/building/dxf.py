"""The plan of a building as DXF, in metres: storeys beside each other, from the lowest."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trihedron.pipeline.core.files import new_file
from trihedron.pipeline.core.types import F64, OPENING_KINDS, Building
from trihedron.plugins.building.geometry import box_place, door_swing, doors_on, extent, open_edges, quad, rings_of, rooms_on, wall_pieces
from trihedron.plugins.building.labels import area_text, label_of, name_of, use_of

DXF = "floorplan.dxf"
LAYERS = {"ROOMS": 8, "WALLS": 7, "UNSEEN": 1, "DOORS": 3, "WINDOWS": 5, "TEXT": 2}  # name -> AutoCAD colour

TEXT_M = (0.15, 0.1, 0.06)  # heights of a room's text, the first that fits


def write_dxf(path: Path, building: Building) -> None:
    """Write the plan as DXF R2010 in metres, with a layer for each of LAYERS."""
    import ezdxf
    from ezdxf import units
    from ezdxf.enums import TextEntityAlignment

    document = ezdxf.filemanagement.new("R2010", setup=["linetypes"])
    document.units = units.M
    for name, color in LAYERS.items():
        document.layers.add(name, color=color, linetype="DASHED" if name == "UNSEEN" else "CONTINUOUS")
    space, low_high = document.modelspace(), extent(building)
    pitch = float(low_high[1][0] - low_high[0][0]) + 1.5
    for storey in range(len(building.storeys)):
        shift = np.array([storey * pitch, 0.0])
        for room in rooms_on(building, storey):
            for of, a, b in building.loops:
                if of == room:
                    space.add_lwpolyline((building.corners_m[a:b] + shift).tolist(), close=True, dxfattribs={"layer": "ROOMS"})
            for p, q in open_edges(building, room):
                space.add_line((p + shift).tolist(), (q + shift).tolist(), dxfattribs={"layer": "UNSEEN"})
            text = " – ".join(filter(None, (label_of(building, "room", room), use_of(building, room)))) + f": {area_text(building, room)}"
            height, place = _text_place(building, room, len(text))
            label = space.add_text(text, height=height, dxfattribs={"layer": "TEXT"})
            label.set_placement((place + shift).tolist(), align=TextEntityAlignment.MIDDLE_CENTER)
        for wall in np.nonzero(building.wall_storeys == storey)[0]:
            for piece in wall_pieces(building, wall):
                layer = "WALLS" if piece.seen else "UNSEEN"
                space.add_lwpolyline((piece.corners + shift).tolist(), close=True, dxfattribs={"layer": layer})
        for opening, wall in enumerate(building.opening_walls):
            if building.wall_storeys[wall] == storey:
                layer = "WINDOWS" if OPENING_KINDS[building.opening_kinds[opening]] == "window" else "DOORS"
                corners = quad(building, int(wall), *building.spans_m[opening]) + shift
                space.add_lwpolyline(corners.tolist(), close=True, dxfattribs={"layer": layer})
                if name := name_of(building, "opening", opening):
                    label = space.add_text(name, height=0.1, dxfattribs={"layer": "TEXT"})
                    label.set_placement(corners.mean(axis=0).tolist(), align=TextEntityAlignment.MIDDLE_CENTER)
    with new_file(path) as new:
        document.saveas(new)


def _text_place(building: Building, room: int, letters: int) -> tuple[float, F64]:
    """Return the height of a room's text and its middle (2,), beside the swings of doors; the least height where none fits."""
    import shapely

    rings, storey = rings_of(building, room), int(building.room_storeys[room])
    swings = [shapely.Polygon(door_swing(building, door)) for door in doors_on(building, storey)]
    free = shapely.make_valid(shapely.Polygon(rings[0], rings[1:])).difference(shapely.union_all(swings))
    for height in TEXT_M:
        if (place := box_place(free, letters * height, 2.0 * height)) is not None:
            return height, place
    return TEXT_M[-1], np.array(shapely.point_on_surface(free).coords[0])
