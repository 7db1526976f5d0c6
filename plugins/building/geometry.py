"""The geometry of a building: pieces of its walls on the plan, and the solids of its model in 3D; metres, in the building's frame.

Walls whose other face was not seen are sheets; stretches of walls without a reading are pieces of their own. A storey without a floor or a ceiling is
taken to be NOMINAL_M high, and its unseen level is left out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from trihedron.pipeline.core.drawings import Drawing, Outline, Solid
from trihedron.pipeline.core.geometry import transform
from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.plan_areas import edges_of
from trihedron.pipeline.core.registry import register_drawing
from trihedron.pipeline.core.types import F64, I32, OPENING_KINDS, Building
from trihedron.plugins.building.labels import label_of

SHEET_M = 0.06  # thickness that a wall is drawn with where its other face was not seen
JOIN_M = 0.001  # between pieces of walls that are one
NOMINAL_M = 2.5  # of a storey whose floor or ceiling was not seen
MODEL_COLORS = {"floor": (205, 190, 165, 255), "ceiling": (240, 240, 240, 255), "wall": (225, 228, 232, 255), "unseen": (220, 80, 70, 110)}  # RGBA
CEILING = "ceiling"
BOX = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [3, 2, 1, 0], [4, 5, 6, 7]])  # faces of a box, outward


# On the plan.


@dataclass(frozen=True)
class Stretch:
    """A piece of a wall between two places along it: its four corners (4, 2), the face first; `seen` False where no reading was."""

    corners: F64
    seen: bool


def wall_pieces(building: Building, wall: Any) -> Iterator[Stretch]:
    """Cut a wall at its openings that reach the floor and at stretches that were not seen."""
    start, end = building.walls_m[wall]
    length = float(norm(end - start))
    gaps = [
        span
        for span, of, kind in zip(building.spans_m, building.opening_walls, building.opening_kinds)
        if of == wall and OPENING_KINDS[kind] != "window"
    ]
    blind = [row[1:] for row in building.unseen if int(row[0]) == wall]
    cuts = np.unique(np.clip([0.0, length, *np.ravel(gaps), *np.ravel(blind)], 0.0, length))
    for a, b in pairwise(cuts):
        middle = (a + b) / 2.0
        if b - a > 1e-6 and not any(low < middle < high for low, high in gaps):
            yield Stretch(quad(building, wall, a, b), not any(low < middle < high for low, high in blind))


def quad(building: Building, wall: int, a: float, b: float) -> F64:
    """Return the corners (4, 2) of a wall's stretch."""
    start, end = building.walls_m[wall]
    along = (end - start) / max(float(norm(end - start)), 1e-9)
    back = np.array([along[1], -along[0]]) * _drawn_thickness(building, wall)
    return np.array([start + a * along, start + b * along, start + b * along + back, start + a * along + back])


def extent(building: Building) -> tuple[F64, F64]:
    """Return the least and the greatest corner (2,) of rooms and faces of walls."""
    points = np.concatenate([building.corners_m, building.walls_m.reshape(-1, 2)])
    return (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.array([3.0, 1.0]))


def rooms_on(building: Building, storey: int) -> list[int]:
    """Return the rooms of a storey."""
    return [k for k in range(len(building.areas_m2)) if building.room_storeys[k] == storey]


def rings_of(building: Building, room: int) -> list[F64]:
    """Return the corners (n, 2) of a room's outer ring, anticlockwise, and of its holes."""
    return [building.corners_m[a:b] for of, a, b in building.loops if of == room]


def open_edges(building: Building, room: int) -> Iterator[F64]:
    """Yield the edges (2, 2) of a room that nothing bounds."""
    yield from (np.array([p, q]) for p, q, wall in edges_of(building, room) if wall < 0)


def wall_corners(building: Building, room: int) -> Iterator[F64]:
    """Yield the pieces (4, 2) of walls outside the corners of a room where two walls meet that were seen there."""
    for piece, walls in _corner_pieces(building, room):
        if not any(_unseen_at(building, wall, piece[0]) for wall in walls):
            yield piece


def _corner_pieces(building: Building, room: int) -> Iterator[tuple[F64, tuple[int, int]]]:
    """Yield the pieces (4, 2) of walls outside the corners of a room, the corner first, and the two walls that meet there in the ring's order."""
    for ring in building.loops[building.loops[:, 0] == room]:
        corners, walls = building.corners_m[ring[1] : ring[2]], building.corner_walls[ring[1] : ring[2]]
        ahead = np.roll(corners, -1, axis=0) - corners
        outward = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)[:, None]
        for k, corner in enumerate(corners):
            if walls[k] >= 0 and walls[k - 1] >= 0:
                first, second = (outward[j] * _drawn_thickness(building, walls[j]) for j in (k - 1, k))
                yield np.array([corner, corner + first, corner + first + second, corner + second]), (int(walls[k - 1]), int(walls[k]))


def joined_spans(building: Building, storey: int) -> dict[int, tuple[float, float]]:
    """Return begin and end along each wall of a storey: its own, or, at a corner that no wall fills, the outer face of the wall that it meets."""
    import shapely

    spans = {int(k): (0.0, float(norm(building.walls_m[k, 1] - building.walls_m[k, 0]))) for k in np.nonzero(building.wall_storeys == storey)[0]}
    for room in rooms_on(building, storey):
        for piece, (wall, _) in _corner_pieces(building, room):
            x, y = piece.mean(axis=0)
            if wall in spans and not any(shapely.contains_xy(shapely.Polygon(quad(building, k, *span)), x, y) for k, span in spans.items()):
                start, end = building.walls_m[wall]
                t = matmul(piece - start, end - start) / max(float(norm(end - start)), 1e-9)
                spans[wall] = min(spans[wall][0], float(t.min())), max(spans[wall][1], float(t.max()))
    return spans


def floor_plate(building: Building, storey: int) -> Any:
    """Return the area (shapely) that the slabs of a storey cover: its rooms with the walls round them; empty where there is no room."""
    import shapely

    rings = [rings_of(building, room) for room in rooms_on(building, storey)]
    rooms = [shapely.make_valid(shapely.Polygon(outer, holes)) for outer, *holes in rings]
    walls = [shapely.Polygon(quad(building, wall, *span)) for wall, span in joined_spans(building, storey).items()]
    return close_gaps([*rooms, *walls] if rooms else [], SHEET_M / 2.0)


def close_gaps(polygons: Iterable[Any], reach_m: float) -> Any:
    """Return the union of polygons (shapely) without gaps narrower than 2 `reach_m`: their morphological closing."""
    import shapely

    grown = shapely.union_all([polygon.buffer(reach_m, join_style="mitre") for polygon in polygons])
    return grown.buffer(-reach_m, join_style="mitre").simplify(JOIN_M)


def rings_of_parts(area: Any) -> list[list[F64]]:
    """Return the rings (n, 2) of each part of an area (shapely), the outer one first."""
    parts = [part for part in getattr(area, "geoms", [area]) if not part.is_empty]
    return [[np.array(ring.coords)[:-1] for ring in (part.exterior, *part.interiors)] for part in parts]


def _drawn_thickness(building: Building, wall: Any) -> float:
    return float(building.thickness_m[wall]) if np.isfinite(building.thickness_m[wall]) else SHEET_M


def _unseen_at(building: Building, wall: Any, corner: F64) -> bool:
    """Say if a wall was not seen where a corner (2,) is."""
    start, end = building.walls_m[wall]
    t = float(matmul(corner - start, end - start)) / max(float(norm(end - start)), 1e-9)
    return any(low - 0.05 <= t <= high + 0.05 for of, low, high in building.unseen if int(of) == wall)


def door_swing(building: Building, opening: int) -> F64:
    """Return the corners (4, 2) of the square in which a door's leaf is drawn: hinge, other jamb, and both a leaf's width before the wall's face."""
    left, right = building.spans_m[opening]
    hinge, jamb, _, back = quad(building, int(building.opening_walls[opening]), float(left), float(right))
    out = (hinge - back) / max(float(norm(hinge - back)), 1e-9) * float(right - left)
    return np.array([hinge, jamb, jamb + out, hinge + out])


def openings_on(building: Building, storey: int) -> list[int]:
    """Return the openings of a storey."""
    return [k for k, wall in enumerate(building.opening_walls) if building.wall_storeys[wall] == storey]


def doors_on(building: Building, storey: int) -> list[int]:
    """Return the doors of a storey."""
    return [k for k in openings_on(building, storey) if OPENING_KINDS[building.opening_kinds[k]] == "door"]


def box_place(free: Any, wide: float, high: float) -> F64 | None:
    """Return the middle (2,) of a box within a region where it is about as far from the outline as it can be (the pole of inaccessibility), of all
    such places that nearest to the region's centroid; None where no box fits."""
    import shapely

    corners = np.array([[-wide, -high], [wide, -high], [wide, high], [-wide, high]]) / 2.0
    rings = [ring for part in getattr(free, "geoms", [free]) if part.geom_type == "Polygon" for ring in (part.exterior, *part.interiors)]
    swept = [shapely.MultiPoint(np.concatenate([corners + p, corners + q])).convex_hull for ring in rings for p, q in pairwise(ring.coords)]
    middles = shapely.difference(free, shapely.union_all(swept))
    if middles.is_empty or middles.area < 1e-9:
        return None
    radius = shapely.maximum_inscribed_circle(middles, 0.01 * high).length
    _, place = shapely.shortest_line(free.centroid, middles.buffer(-LEEWAY * radius)).coords
    return np.array(place)


LEEWAY = 0.9  # of the greatest distance from the outline, that is enough


# In 3D.


@dataclass(frozen=True)
class Part:
    """Triangles (t, 3) over vertices (v, 3) of one kind (a key of MODEL_COLORS) of a storey; their normals by the right-hand rule point away from
    the solid."""

    storey: int
    kind: str
    vertices_m: F64
    triangles: I32


def storey_levels(building: Building, storey: int) -> tuple[float, float]:
    """Return the heights of floor and ceiling, NOMINAL_M apart where one was not seen."""
    floor, ceiling = (float(value) for value in building.storeys[storey])
    if not np.isfinite(floor):
        floor = ceiling - NOMINAL_M if np.isfinite(ceiling) else 0.0
    return floor, ceiling if np.isfinite(ceiling) else floor + NOMINAL_M


def wall_boxes(building: Building, wall: int) -> Iterator[tuple[float, float, float, float, bool]]:
    """Yield the solid boxes of a wall: begin and end along it, bottom and top above its storey's floor, and if any of it was seen."""
    start, end = building.walls_m[wall]
    low, high = storey_levels(building, int(building.wall_storeys[wall]))
    length = float(norm(end - start))
    mine = np.nonzero(building.opening_walls == wall)[0]
    blind = [row[1:] for row in building.unseen if int(row[0]) == wall]
    cuts = np.unique(np.clip([0.0, length, *building.spans_m[mine].ravel(), *np.ravel(blind)], 0.0, length))
    for a, b in pairwise(cuts):
        middle, bottom = (a + b) / 2.0, 0.0
        if b - a < 1e-6:
            continue
        seen = not any(begin < middle < stop for begin, stop in blind)
        gaps = [building.opening_heights_m[k] for k in mine if building.spans_m[k, 0] < middle < building.spans_m[k, 1]]
        for gap_bottom, gap_top in sorted((float(lower), float(upper)) for lower, upper in gaps):
            if gap_bottom - bottom > 1e-6:
                yield float(a), float(b), bottom, gap_bottom, seen
            bottom = max(bottom, gap_top)
        if high - low - bottom > 1e-6:
            yield float(a), float(b), bottom, high - low, seen


def parts_of(building: Building, ceilings: bool = True) -> list[Part]:
    """Return the parts of the model, those without a triangle left out."""
    out = []
    for storey in range(len(building.storeys)):
        low, _ = storey_levels(building, storey)
        boxes: dict[str, list[F64]] = {"wall": [], "unseen": []}
        for wall in np.nonzero(building.wall_storeys == storey)[0]:
            for a, b, bottom, top, seen in wall_boxes(building, int(wall)):
                boxes["wall" if seen else "unseen"].append(_box(quad(building, int(wall), a, b), low + bottom, low + top))
        triangles = np.concatenate([BOX[:, [0, 1, 2]], BOX[:, [0, 2, 3]]])
        for kind, found in boxes.items():
            if found:
                out.append(Part(storey, kind, np.concatenate(found), np.concatenate([triangles + 8 * k for k in range(len(found))]).astype(np.int32)))
        floor, ceiling = building.storeys[storey]
        for kind, height, wanted in (("floor", floor, True), (CEILING, ceiling, ceilings)):
            flat = [_level(rings_of(building, room), float(height), kind == "floor") for room in rooms_on(building, storey)]
            if wanted and np.isfinite(height) and flat:
                starts = np.cumsum([0, *(len(vertices) for vertices, _ in flat)])
                vertices = np.concatenate([vertices for vertices, _ in flat])
                out.append(Part(storey, kind, vertices, np.concatenate([t + n for (_, t), n in zip(flat, starts)]).astype(np.int32)))
    return [part for part in out if len(part.triangles)]


@register_drawing(Building)
def drawing_of_building(building: Building) -> Drawing:
    """Draw the model without its ceilings, and the outline of each room with its area."""
    T, outlines = building.T_world_building, []
    solids = (
        Solid(f"{part.storey}/{part.kind}", MODEL_COLORS[part.kind], transform(T, part.vertices_m), part.triangles)
        for part in parts_of(building, ceilings=False)
    )
    for room, (area, storey) in enumerate(zip(building.areas_m2, building.room_storeys)):
        ring, height = rings_of(building, room)[0], float(np.nan_to_num(building.storeys[storey, 0]))
        closed = np.column_stack([ring, np.full(len(ring), height)])[[*range(len(ring)), 0]]
        outlines.append(Outline(f"room_{room}", f"{label_of(building, 'room', room)}: {area:.1f} m²", transform(T, closed)))
    return Drawing(tuple(solids), tuple(outlines))


def _box(corners: F64, bottom: float, top: float) -> F64:
    """Return the corners (8, 3) of a box over four corners (4, 2), anticlockwise from above, those below first."""
    ring = corners if _turn(corners) > 0.0 else corners[::-1]
    return np.concatenate([np.column_stack([ring, np.full(4, height)]) for height in (bottom, top)])


def _turn(ring: F64) -> float:
    """Return twice the signed area of a ring (n, 2)."""
    x, y = ring.T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _level(rings: list[F64], height: float, up: bool) -> tuple[F64, I32]:
    """Triangulate a polygon at a height, facing up or down."""
    import shapely

    polygon = shapely.make_valid(shapely.Polygon(rings[0], rings[1:]))
    pieces = [part for part in getattr(polygon, "geoms", [polygon]) if part.geom_type == "Polygon" and part.area > 0.0]
    faces = [np.array(part.exterior.coords)[:3] for piece in pieces for part in shapely.constrained_delaunay_triangles(piece).geoms]
    turned = [face if (_turn(face) > 0.0) == up else face[::-1] for face in faces]
    points = np.concatenate(turned) if turned else np.empty((0, 2))
    return np.column_stack([points, np.full(len(points), height)]), np.arange(len(points), dtype=np.int32).reshape(-1, 3)
