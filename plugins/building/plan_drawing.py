"""The plan of a building on a sheet: storeys beside each other, from the lowest, with names, areas, dimensions and a legend.

A name or a height that has no place of its own is a number on the plan and a line of the legend: no letters cross a wall, the swing of a door or each
other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from trihedron.pipeline.core.linalg import norm
from trihedron.pipeline.core.plan_areas import edges_of
from trihedron.pipeline.core.types import F64, OPENING_KINDS, Building
from trihedron.plugins.building.dimensions import Chain, chains_of, covers
from trihedron.plugins.building.geometry import (
    box_place,
    door_swing,
    doors_on,
    open_edges,
    openings_on,
    quad,
    rings_of,
    rooms_on,
    wall_corners,
    wall_pieces,
)
from trihedron.plugins.building.labels import area_text, id_of, label_of, title_of
from trihedron.plugins.building.legend import legend_groups, title_of_plan
from trihedron.plugins.building.sheet import FONTS, Group, Letters, Mark, Shape, Sheet, bounds, line, moved, width_of

EDGE, GAP, ROW = 14.0, 40.0, 17.0  # points: round the sheet, between storeys, between rows of dimensions
CLEAR = 1.5  # points between letters and what they must not cross
TICK, ABOVE, BEYOND = 3.0, -6.0, 7.5  # points: half a tick; the middle of a number from its line, where it fits and where it does not
SHIFTS = (0.0, 1.0, -1.0, 2.0, -2.0)  # steps by which a number gives way to another
SHORTEST_INNER_M = 0.8  # edge whose length is written inside
ALONG = (0.5, 0.35, 0.65, 0.2, 0.8)  # shares of an edge where its length is written, the first that is free


def draw_plan(building: Building, per_m: float, name: str = "", scale: str = "") -> Sheet:
    """Draw all storeys at a scale, points of paper per metre. `name` is that of the run, `scale` the scale as the title has it."""
    listed: list[str] = []
    groups: list[Group] = []
    x = 0.0
    for storey in range(len(building.storeys)):
        drawn = _Storey(building, storey, per_m, listed).groups()
        low, high = bounds(drawn)
        groups += moved(drawn, np.array([x - low[0], 0.0]))
        x += high[0] - low[0] + GAP
    low, high = bounds(groups)
    title = title_of_plan(building, name, scale)
    groups.append(Group((title.moved(np.array([low[0], low[1] - 16.0]) - title.corners()[3]),)))
    legend = legend_groups(
        building, per_m, listed, high[0] - low[0], {mark.style for group in groups for mark in group.marks if isinstance(mark, Shape)}
    )
    groups += moved(legend, np.array([low[0], high[1] + 22.0]) - bounds(legend)[0])
    low, high = bounds(groups)
    return Sheet(high - low + 2.0 * EDGE, tuple(moved(groups, EDGE - low)))


@dataclass
class _Storey:
    """A storey that is being drawn: points on paper are `per_m` times metres, y down."""

    building: Building
    storey: int
    per_m: float
    listed: list[str]  # what numbers on the plans stand for
    taken: list[Any] = field(default_factory=list)  # polygons that no letters may cross

    def groups(self) -> list[Group]:
        """Draw all of it."""
        building, chains = self.building, chains_of(self.building, self.storey)
        openings = openings_on(building, self.storey)
        drawn = [*self._surfaces(), *(self._opening(k) for k in openings)]
        self.taken = list(self._obstacles())
        texts: list[Mark] = []
        for room in sorted(rooms_on(building, self.storey), key=lambda room: -float(building.areas_m2[room])):
            texts += self._room_label(room)
        for opening in openings:
            texts += self._heights(opening)
        texts += [text for p, q in self._lengths(chains) if (text := self._length(p, q)) is not None]
        drawn += [Group(tuple(texts)), *self._chains(chains, *bounds([*drawn, Group(tuple(texts))]))]
        if len(building.storeys) > 1:
            low, high = bounds(drawn)
            drawn.append(Group((Letters("name", f"storey {self.storey}", np.array([(low[0] + high[0]) / 2.0, high[1] + 16.0])),)))
        return drawn

    def at(self, points: F64) -> F64:
        """Return points (..., 2) of the plan on the paper."""
        return np.asarray(points, np.float64) * [self.per_m, -self.per_m]

    def _surfaces(self) -> Iterator[Group]:
        """Draw rooms, walls, and edges that nothing bounds."""
        building, rooms = self.building, rooms_on(self.building, self.storey)
        for room in rooms:
            yield self._group("room", room, [Shape("room", tuple(self.at(ring) for ring in rings_of(building, room)))])
        for wall in np.nonzero(building.wall_storeys == self.storey)[0]:
            pieces = [Shape("wall" if piece.seen else "completed", (self.at(piece.corners),)) for piece in wall_pieces(building, wall)]
            yield self._group("wall", int(wall), pieces)
        yield Group(tuple(Shape("wall", (self.at(corner),)) for room in rooms for corner in wall_corners(building, room)))
        yield Group(tuple(line("unseen", *self.at(edge)) for room in rooms for edge in open_edges(building, room)))

    def _group(self, element: str, k: int, marks: Any) -> Group:
        return Group(tuple(marks), id_of(self.building, element, k), title_of(self.building, element, k))

    def _opening(self, k: int) -> Group:
        """Draw a window as glass, a door as a leaf with its swing, a passage as a gap. Which way a door turns is not known: a convention."""
        building, kind = self.building, OPENING_KINDS[self.building.opening_kinds[k]]
        marks: list[Shape] = []
        if kind == "window":
            marks = [Shape("glass", (self.at(quad(building, int(building.opening_walls[k]), *building.spans_m[k])),))]
        elif kind == "door":
            hinge, tip, _, leaf = door_swing(building, k)
            angles = np.linspace(0.0, np.pi / 2.0, 19)[:, None]
            marks = [
                line("leaf", *self.at(np.array([hinge, leaf]))),
                line("swing", *self.at(hinge + np.cos(angles) * (tip - hinge) + np.sin(angles) * (leaf - hinge))),
            ]
        return self._group("opening", k, marks)

    def _obstacles(self) -> Iterator[Any]:
        """Yield polygons of the walls, with their windows, of edges that nothing bounds, and of the swings of doors."""
        import shapely

        building, rooms = self.building, rooms_on(self.building, self.storey)
        for wall in np.nonzero(building.wall_storeys == self.storey)[0]:
            yield from (shapely.Polygon(self.at(piece.corners)).buffer(CLEAR) for piece in wall_pieces(building, wall))
        for room in rooms:
            yield from (shapely.Polygon(self.at(corner)).buffer(CLEAR) for corner in wall_corners(building, room))
            yield from (shapely.LineString(self.at(edge)).buffer(CLEAR) for edge in open_edges(building, room))
        yield from (shapely.Polygon(self.at(door_swing(building, door))).buffer(CLEAR) for door in doors_on(building, self.storey))

    def _room_label(self, room: int) -> list[Mark]:
        """Write name and area of a room inside it: across or upright, in small letters where there is little room, else a number for the legend."""
        import shapely

        rings = [self.at(ring) for ring in rings_of(self.building, room)]
        free = shapely.make_valid(shapely.Polygon(rings[0], rings[1:])).difference(shapely.union_all(self.taken))
        name, area = label_of(self.building, "room", room), area_text(self.building, room)
        lines = [[name, area], [name, *area.replace(" (", "\n(").split("\n")]]
        ways = [(size, text, angle) for size in ("", " small") for angle in (0.0, -90.0) for text in lines]
        for size, text, angle in ways:
            if (marks := _block(free, text, size, angle)) is not None:
                return self._keep(marks)
        number = self._number(f"{name}, {area}")
        marks = _block(free, [number], " small", 0.0) or [Letters("name small", number, np.array(shapely.point_on_surface(free).coords[0]))]
        return self._keep(marks)

    def _number(self, text: str) -> str:
        """Return the number that stands for a text of the legend."""
        self.listed.append(text)
        return str(len(self.listed))

    def _keep(self, marks: list[Letters]) -> list[Mark]:
        """Return marks, with their places taken."""
        self.taken += [mark.box().buffer(CLEAR) for mark in marks]
        return [*marks]

    def _free(self, text: Letters) -> bool:
        box = text.box()
        return not any(box.intersects(other) for other in self.taken)

    def _heights(self, k: int) -> list[Mark]:
        """Write the sill and the head of a window, the height of a door, beside it."""
        kind, (bottom, top) = OPENING_KINDS[self.building.opening_kinds[k]], self.building.opening_heights_m[k]
        if kind == "passage":
            return []
        text = f"sill {bottom:.2f}, head {top:.2f}" if kind == "window" else f"{top:.2f}"
        if (found := self._beside(k, text)) is not None:
            return self._keep([found])
        found = self._beside(k, str(len(self.listed) + 1))
        number = self._number(f"{label_of(self.building, 'opening', k)}: {text}") if found else None
        return self._keep([found]) if found and number else []

    def _beside(self, k: int, text: str) -> Letters | None:
        """Return a text along an opening's wall, on one side of it or the other, where it is free; None where it is not."""
        left, right, behind, _ = self.at(quad(self.building, int(self.building.opening_walls[k]), *self.building.spans_m[k]))
        along = (right - left) / max(float(norm(right - left)), 1e-9)
        out = (right - behind) / max(float(norm(right - behind)), 1e-9)
        wide, reach = width_of(text, "height"), FONTS["height"].size / 2.0 + 2.0 * CLEAR
        beyond = (float(norm(right - left)) + wide) / 2.0 + CLEAR
        for shift in (0.0, beyond, -beyond):
            for start in (left + reach * out, left + (behind - right) - reach * out):
                place = start + (right - left) / 2.0 + shift * along
                if self._free(letters := Letters("height", text, place, _upright(along))):
                    return letters
        return None

    def _lengths(self, chains: list[Chain]) -> Iterator[tuple[F64, F64]]:
        """Yield the ends of edges of rooms that are walls and whose length no chain gives; without any room, of the walls."""
        building, rooms = self.building, rooms_on(self.building, self.storey)
        for room in rooms:
            for p, q, wall in edges_of(building, room):
                if wall >= 0 and not covers(chains, p, q):
                    yield p, q
        if not rooms:
            yield from ((p, q) for p, q in building.walls_m[building.wall_storeys == self.storey])

    def _length(self, p: F64, q: F64) -> Letters | None:
        """Write the length of an edge on its left where that is free."""
        length = float(norm(q - p))
        if length < SHORTEST_INNER_M:
            return None
        along = self.at(q - p) / (self.per_m * length)
        left = np.array([along[1], -along[0]]) * (FONTS["length"].size / 2.0 + 3.0 * CLEAR)
        for share in ALONG:
            text = Letters("length", f"{length:.2f}", self.at(p + share * (q - p)) + left, _upright(along))
            if self._free(text):
                self._keep([text])
                return text
        return None

    def _chains(self, chains: list[Chain], low: F64, high: F64) -> list[Group]:
        """Draw the chains beyond the bounds of the plan on paper, the stretches first, the whole beyond them."""
        marks: list[Mark] = []
        for chain in chains:
            edge = (low if (chain.axis == 0) == chain.high else high)[1 - chain.axis]
            outward = -1.0 if (chain.axis == 0) == chain.high else 1.0
            numbers: list[Any] = []
            for k, row in enumerate(chain.rows, 1):
                ends = np.array(row) * (self.per_m if chain.axis == 0 else -self.per_m)
                marks += _dimension_row(chain.axis, edge + outward * k * ROW, outward, ends, self.per_m, numbers)
                stops = [_on(chain.axis, stop, edge + outward * k * ROW) for stop in np.unique(ends)]
                marks += [line("dimension", stop, stop - _on(chain.axis, 0.0, outward * (ROW - TICK))) for stop in stops]
        return [Group(tuple(marks))]


def _block(free: Any, lines: list[str], size: str, angle: float) -> list[Letters] | None:
    """Return lines of text upon each other at the place of a region that is farthest from its outline; None where they do not fit."""
    fonts = [f"name{size}", *[f"area{size}"] * (len(lines) - 1)]
    wide, heights = max(width_of(text, font) for text, font in zip(lines, fonts)), [1.3 * FONTS[font].size for font in fonts]
    box = np.array([wide, sum(heights)]) + 2.0 * CLEAR
    place = box_place(free, *(box if angle == 0.0 else box[::-1]))
    if place is None:
        return None
    down = np.array([0.0, 1.0]) if angle == 0.0 else np.array([1.0, 0.0])
    middles = np.cumsum(heights) - np.array(heights) / 2.0 - sum(heights) / 2.0
    return [Letters(font, text, place + y * down, angle) for text, font, y in zip(lines, fonts, middles)]


def _dimension_row(axis: int, level: float, outward: float, ends: F64, per_m: float, numbers: list[Any]) -> Iterator[Mark]:
    """Draw a row of dimensions (n, 2) on paper: lines with ticks, and lengths to the centimetre above them, or where they are wider than their
    stretch on the side away from the plan (`outward`, -1 or 1), beside the `numbers` that are there, polygons, to which they are added."""
    for stop in np.unique(ends):
        yield line("tick", *(_on(axis, stop + way * TICK, level - way * TICK) for way in (-1.0, 1.0)))
    for begin, end in ends:
        yield line("dimension", _on(axis, begin, level), _on(axis, end, level))
        length = abs(end - begin)
        text = f"{length / per_m:.2f}"
        fits = width_of(text, "length") + 2.0 * TICK <= length
        side, step = (ABOVE, 0.15 * length) if fits else (outward * BEYOND, 14.0)
        angle, middle = 0.0 if axis == 0 else -90.0, (begin + end) / 2.0
        ways = [Letters("length", text, _on(axis, middle + k * step, level + side), angle) for k in SHIFTS]
        found = next((way for way in ways if not any(way.box().intersects(other) for other in numbers)), ways[0])
        numbers.append(found.box())
        yield found


def _on(axis: int, place: float, level: float) -> F64:
    """Return the point (2,) at a place along an axis."""
    return np.array([place, level] if axis == 0 else [level, place])


def _upright(along: F64) -> float:
    """Return the angle of letters along a direction on paper that are read from below or from the right, clockwise."""
    return round((float(np.degrees(np.arctan2(along[1], along[0]))) + 90.0 + 1e-6) % 180.0 - 90.0, 3)
