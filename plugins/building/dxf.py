"""The plan of a building as DXF, in metres, on layers named as the AIA does: storeys beside each other, from the lowest."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.files import new_file
from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.core.types import F64, OPENING_KINDS, Building
from trihedron.plugins.building.dimensions import chains_of
from trihedron.plugins.building.geometry import (
    JOIN_M,
    box_place,
    close_gaps,
    door_swing,
    doors_on,
    extent,
    open_edges,
    openings_on,
    quad,
    rings_of,
    rings_of_parts,
    rooms_on,
    wall_corners,
    wall_pieces,
)
from trihedron.plugins.building.labels import area_text, name_of, title_of

DXF = "floorplan.dxf"
WALL, UNSEEN, DOOR, GLASS, AREA, DIMENSION, TEXT = "A-WALL", "A-WALL-UNSN", "A-DOOR", "A-GLAZ", "A-AREA", "A-ANNO-DIMS", "A-ANNO-TEXT"
LAYERS = {WALL: 7, UNSEEN: 1, DOOR: 3, GLASS: 5, AREA: 8, DIMENSION: 9, TEXT: 2}  # name -> AutoCAD colour
TEXT_M = (0.15, 0.1, 0.06)  # heights of a room's text, the first that fits
LETTER = 0.8  # of its height, a letter's width
APART_M = 0.5  # the rows of dimensions from each other, and from the plan
GAP_M = 3.5  # between storeys


def has_dxf() -> bool:
    """Say if ezdxf is installed."""
    return find_spec("ezdxf") is not None


def write_dxf(path: Path, building: Building) -> None:
    """Write the plan as DXF R2010 in metres, with a layer for each of LAYERS. Raises LibraryError where ezdxf is not installed."""
    with imports_of("ezdxf"):
        import ezdxf
        from ezdxf import units

    document = ezdxf.filemanagement.new("R2010", setup=["linetypes", "styles"])
    document.units = units.M
    for name, color in LAYERS.items():
        document.layers.add(name, color=color, linetype="DASHED" if name == UNSEEN else "CONTINUOUS")
    look = {"dimtxt": 0.12, "dimtsz": 0.06, "dimexe": 0.08, "dimexo": 0.1, "dimgap": 0.04, "dimtad": 1, "dimdec": 2, "dimzin": 0, "dimdsep": ord(".")}
    document.dimstyles.new("METRES", dxfattribs=look)
    low, high = extent(building)
    for storey in range(len(building.storeys)):
        _Storey(building, storey, document.modelspace(), np.array([storey * (high[0] - low[0] + GAP_M), 0.0])).draw()
    with new_file(path) as new:
        document.saveas(new)


class _Storey:
    """A storey that is being drawn, beside its place in the building's frame by `shift` (2,)."""

    def __init__(self, building: Building, storey: int, space: Any, shift: F64) -> None:
        self.building, self.storey, self.space, self.shift = building, storey, space, shift

    def draw(self) -> None:
        """Draw all of it."""
        seen, unseen = (list(self._pieces(seen)) for seen in (True, False))
        for ring in outlines(seen):
            self._ring(ring, WALL)
        for ring in outlines(unseen):
            self._ring(ring, UNSEEN)
        for room in rooms_on(self.building, self.storey):
            self._room(room)
        for opening in openings_on(self.building, self.storey):
            self._opening(opening)
        self._dimensions()

    def _pieces(self, seen: bool) -> Iterator[F64]:
        """Yield the corners of the pieces of walls that were seen, those that join them at corners included, or of those that were not."""
        for wall in np.nonzero(self.building.wall_storeys == self.storey)[0]:
            yield from (piece.corners for piece in wall_pieces(self.building, wall) if piece.seen == seen)
        for room in rooms_on(self.building, self.storey) if seen else ():
            yield from wall_corners(self.building, room)

    def _ring(self, ring: F64, layer: str) -> None:
        self.space.add_lwpolyline((ring + self.shift).tolist(), close=True, dxfattribs={"layer": layer})

    def _line(self, p: F64, q: F64, layer: str) -> None:
        self.space.add_line((p + self.shift).tolist(), (q + self.shift).tolist(), dxfattribs={"layer": layer})

    def _text(self, text: str, height: float, place: F64) -> None:
        from ezdxf.enums import TextEntityAlignment

        label = self.space.add_text(text, height=height, dxfattribs={"layer": TEXT})
        label.set_placement((place + self.shift).tolist(), align=TextEntityAlignment.MIDDLE_CENTER)

    def _room(self, room: int) -> None:
        """Draw the outline of a room, its edges that nothing bounds, and its name and area."""
        for ring in rings_of(self.building, room):
            self._ring(ring, AREA)
        for p, q in open_edges(self.building, room):
            self._line(p, q, UNSEEN)
        text = f"{title_of(self.building, 'room', room)}: {area_text(self.building, room)}"
        self._text(text, *_text_place(self.building, room, len(text)))

    def _opening(self, k: int) -> None:
        """Draw the reveal of an opening, of a door its leaf and swing too."""
        building, kind = self.building, OPENING_KINDS[self.building.opening_kinds[k]]
        corners = quad(building, int(building.opening_walls[k]), *building.spans_m[k])
        self._ring(corners, GLASS if kind == "window" else DOOR)
        if kind == "door":
            hinge, tip, _, leaf = door_swing(building, k)
            self._line(hinge, leaf, DOOR)
            first, last = sorted(np.degrees(np.arctan2(*(end - hinge)[::-1])) for end in (tip, leaf))
            first, last = (first, last) if last - first < 180.0 else (last, first)
            radius = float(np.hypot(*(tip - hinge)))
            self.space.add_arc((hinge + self.shift).tolist(), radius, float(first), float(last), dxfattribs={"layer": DOOR})
        if name := name_of(building, "opening", k):
            self._text(name, TEXT_M[1], corners.mean(axis=0))

    def _dimensions(self) -> None:
        """Draw the chains of dimensions round the plan."""
        corners = [ring for room in rooms_on(self.building, self.storey) for ring in rings_of(self.building, room)]
        for chain in chains_of(self.building, self.storey):
            points = np.concatenate(corners)
            edge, outward = (points[:, 1 - chain.axis].max(), 1.0) if chain.high else (points[:, 1 - chain.axis].min(), -1.0)
            for k, row in enumerate(chain.rows, 1):
                for begin, end in row:
                    ends = [np.array([at, edge] if chain.axis == 0 else [edge, at]) + self.shift for at in (begin, end)]
                    base = ends[0] + np.array([0.0, outward] if chain.axis == 0 else [outward, 0.0]) * k * APART_M
                    angle = 0.0 if chain.axis == 0 else 90.0
                    dimension = self.space.add_linear_dim(
                        base.tolist(), ends[0].tolist(), ends[1].tolist(), angle=angle, dimstyle="METRES", dxfattribs={"layer": DIMENSION}
                    )
                    dimension.render()


def outlines(pieces: list[F64]) -> Iterator[F64]:
    """Yield the rings (n, 2) round the union of polygons, holes as rings of their own."""
    import shapely

    for rings in rings_of_parts(close_gaps(map(shapely.Polygon, pieces), JOIN_M)):
        yield from rings


def _text_place(building: Building, room: int, letters: int) -> tuple[float, F64]:
    """Return the height of a room's text and its middle (2,), beside the swings of doors; the least height where none fits."""
    import shapely

    rings, storey = rings_of(building, room), int(building.room_storeys[room])
    swings = [shapely.Polygon(door_swing(building, door)) for door in doors_on(building, storey)]
    free = shapely.make_valid(shapely.Polygon(rings[0], rings[1:])).difference(shapely.union_all(swings))
    for height in TEXT_M:
        if (place := box_place(free, LETTER * letters * height, 2.0 * height)) is not None:
            return height, place
    return TEXT_M[-1], np.array(shapely.point_on_surface(free).coords[0])
