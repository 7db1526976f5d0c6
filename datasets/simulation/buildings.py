"""Scenes of several rooms, each with the walk that shows it: a convex shell that walls, which are boxes, divide. Metres, z up.

Walls come first among the solids: the ray tracer then passes over what they hide."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from trihedron.datasets.simulation.furniture import furniture_along
from trihedron.datasets.simulation.room import HEIGHT_M, UP, Room, Solid, Wall, box, shell, turned_box, walls_of
from trihedron.datasets.simulation.walks import Walk
from trihedron.pipeline.core.linalg import norm

DOORWAY_M = (0.9, 2.1)  # width and height
DETAIL = 0.7  # of the textures: those of a building take as much memory as those of a few rooms
WALL_M = 0.1


@dataclass(frozen=True)
class Building:
    """Solids of a building, and the walk through it."""

    room: Room
    walk: Walk


def rectangle(x: tuple[float, float], y: tuple[float, float]) -> tuple[tuple[float, float], ...]:
    """Return the corners of a rectangle, anticlockwise."""
    return (x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])


def _skirting(wall: Wall) -> Solid:
    return wall.mount_box(wall.length_m / 2.0, (0.0, 0.08), wall.length_m, 0.015, "plastic")


def lamps_at(places: list[tuple[float, float]], ceiling_m: float = HEIGHT_M) -> tuple[list[Solid], tuple[tuple[float, float, float], ...]]:
    """Flat lamps on the ceiling, and where their light comes from."""
    solids = [box((x - 0.3, x + 0.3), (y - 0.3, y + 0.3), (ceiling_m - 0.1, ceiling_m), "plastic") for x, y in places]
    return solids, tuple((x, y, ceiling_m - 0.25) for x, y in places)


def _building(x: float, y: float, solids: list[Solid], lamps: list[tuple[float, float]], walk: Walk) -> Building:
    planes, faces = shell(rectangle((0.0, x), (0.0, y)))
    hanging, lights = lamps_at(lamps)
    return Building(Room(planes, faces, (*solids, *hanging), lights, DETAIL), walk)


def corridor() -> Building:
    """A corridor 2 m wide around a block: 45.6 m along its middle, back to where it began."""
    x, y = 15.7, 11.1
    south, east, north, west = walls_of(rectangle((0.0, x), (0.0, y)))
    inner_west, inner_north, inner_east, inner_south = walls_of(((2.0, 2.0), (2.0, y - 2.0), (x - 2.0, y - 2.0), (x - 2.0, 2.0)))
    solids = [box((2.0, x - 2.0), (2.0, y - 2.0), (0.0, HEIGHT_M), "wall")]
    solids += [_skirting(wall) for wall in (south, east, north, west, inner_west, inner_north, inner_east, inner_south)]
    solids += furniture_along(south, "door 2.6, picture 4.1, cabinet 5.6, portrait 7.0, door 8.4, bin 9.4, picture 10.6, crates 12.0, door 13.9")
    solids += furniture_along(east, "window 1.6, portrait 3.3, door 4.6, bench 6.2, picture 7.6, pilaster 8.6, door 9.8")
    solids += furniture_along(north, "picture 1.0, shelf 2.6, door 4.3, portrait 5.6, window 7.2, globe 9.1, door 10.8, picture 12.2, locker 13.6")
    solids += furniture_along(west, "door 1.3, picture 2.7, locker 4.2, portrait 5.3, door 6.5, crates 7.6, window 9.4")
    solids += furniture_along(inner_south, "pilaster 1.1, picture 2.4, door 4.0, portrait 5.3, bench 6.6, picture 7.9, door 9.5, pilaster 10.7")
    solids += furniture_along(inner_east, "portrait 0.8, door 2.2, pilaster 3.4, picture 4.6, door 6.0")
    solids += furniture_along(inner_north, "door 1.5, picture 3.2, pilaster 4.4, cabinet 5.8, picture 7.4, door 9.0, portrait 10.5")
    solids += furniture_along(inner_west, "picture 1.0, pilaster 2.2, door 3.6, picture 5.2, bin 6.3")
    lamps = [(1.0, 1.0), (5.5, 1.0), (10.0, 1.0), (14.7, 1.0), (14.7, 5.5), (14.7, 10.1), (10.0, 10.1), (5.5, 10.1), (1.0, 10.1), (1.0, 5.5)]
    path = ((6.0, 1.0), (x - 1.0, 1.0), (x - 1.0, y - 1.0), (1.0, y - 1.0), (1.0, 1.0))
    return _building(x, y, solids, lamps, Walk(path, 1.0, 1.0))


def _doorway(along_x: bool, across: tuple[float, float], span: tuple[float, float], at: float) -> list[Solid]:
    """A wall with a doorway `at`: left, right, and above it. `across` is its thickness, `span` its extent, along x or along y."""
    left, right = (span[0], at - DOORWAY_M[0] / 2.0), (at + DOORWAY_M[0] / 2.0, span[1])
    pieces = [(left, (0.0, HEIGHT_M)), (right, (0.0, HEIGHT_M)), ((left[1], right[0]), (DOORWAY_M[1], HEIGHT_M))]
    return [box(part, across, z, "wall") if along_x else box(across, part, z, "wall") for part, z in pieces]


def wall_with_gaps(
    start: tuple[float, float], end: tuple[float, float], gaps: list[tuple[float, float, float, float]], thickness_m: float = WALL_M
) -> list[Solid]:
    """A wall along the middle line from `start` to `end` with gaps (middle along it, width, bottom, top)."""
    a, b = np.array([*start, 0.0]), np.array([*end, 0.0])
    length = float(norm(b - a))
    along = (b - a) / length
    yaw, pieces, at = float(np.arctan2(along[1], along[0])), list[tuple[float, float, float, float]](), 0.0
    for middle, width, bottom, top in sorted(gaps):
        left, right = middle - width / 2.0, middle + width / 2.0
        pieces += [(at, left, 0.0, HEIGHT_M), (left, right, top, HEIGHT_M), *([(left, right, 0.0, bottom)] if bottom else [])]
        at = right
    half = [
        (a + along * (s + t) / 2.0 + UP * (low + high) / 2.0, np.array([(t - s) / 2.0, thickness_m / 2.0, (high - low) / 2.0]))
        for s, t, low, high in [*pieces, (at, length, 0.0, HEIGHT_M)]
    ]
    return [turned_box(centre, size, yaw, "wall") for centre, size in half]


def flat() -> Building:
    """An L-shaped flat: three rooms, the north one L-shaped about a shaft; a door ajar, a wardrobe 2.3 m high, a window between two rooms."""
    x, y = 8.0, 6.0
    door, window = (DOORWAY_M[0], 0.0, DOORWAY_M[1]), (1.0, 0.9, 2.0)
    solids = [box((5.0, x), (3.5, y), (0.0, HEIGHT_M), "wall"), box((0.0, 1.2), (5.0, y), (0.0, HEIGHT_M), "wall")]
    solids += wall_with_gaps((0.0, 3.55), (5.0, 3.55), [(1.4, *window), (3.6, *door)])
    solids += wall_with_gaps((5.05, 0.0), (5.05, 3.5), [(1.75, *door)])
    ajar, leaf = np.radians(75.0), np.array([0.42, 0.02, 1.02])
    hinge = np.array([5.12, 2.2, 1.02])
    solids.append(turned_box(hinge + leaf[0] * np.array([np.sin(ajar), np.cos(ajar), 0.0]), leaf, np.pi / 2.0 - float(ajar), "wood", "door", 3))
    solids.append(box((7.4, x), (0.3, 1.9), (0.0, 2.3), "wood", "drawers", 0))
    south, _, _, _ = walls_of(rectangle((0.0, 5.0), (0.0, 3.5)))
    _, east, north, _ = walls_of(rectangle((1.2, 5.0), (3.6, y)))
    solids += (
        furniture_along(south, "picture 1.0, portrait 2.4, picture 4.0")
        + furniture_along(east, "picture 1.2")
        + furniture_along(north, "portrait 1.0, picture 2.4")
    )
    solids += furniture_along(walls_of(rectangle((0.0, 5.0), (0.0, 3.5)))[3], "picture 1.2, portrait 2.5")
    path = [(2.2, 0.9), (4.2, 1.75), (5.9, 1.75), (6.7, 1.3), (6.8, 2.4), (5.9, 2.0), (4.2, 1.75), (3.6, 2.6), (3.6, 4.2), (4.3, 4.9), (2.6, 5.1)]
    path += [(1.0, 4.4), (1.8, 4.1), (3.6, 4.4), (3.6, 2.6), (1.4, 2.6), (0.9, 1.5)]
    return _building(x, y, solids, [(2.5, 1.7), (6.5, 1.7), (2.8, 4.6)], Walk(tuple(path), 0.5, 0.5))


def slanted_flat() -> Building:
    """Two rooms whose outer walls in the west and north are along no axis, and the wall between them neither."""
    footprint = ((0.0, 0.0), (8.0, 0.0), (8.0, 5.0), (1.5, 4.0))
    planes, faces = shell(footprint)
    south, east, north, west = walls_of(footprint)
    solids = wall_with_gaps((3.6, -0.2), (4.8, 5.2), [(2.3, DOORWAY_M[0], 0.0, DOORWAY_M[1])])
    solids += furniture_along(south, "picture 1.5, portrait 5.6, picture 7.0") + furniture_along(east, "picture 1.2, portrait 3.4")
    solids += furniture_along(north, "portrait 1.6, picture 5.0") + furniture_along(west, "picture 1.2, portrait 2.8")
    hanging, lights = lamps_at([(2.5, 2.0), (6.2, 2.3)])
    path = ((2.4, 1.0), (3.4, 1.9), (4.2, 2.05), (5.4, 1.6), (6.9, 1.1), (7.0, 3.6), (5.6, 3.4), (4.2, 2.05), (3.2, 2.6), (2.3, 3.1), (1.4, 1.6))
    return Building(Room(planes, faces, (*solids, *hanging), lights, DETAIL), Walk(path, 0.5, 0.5))


UPPER_M = 3.0  # the upper floor of the house, above a slab of 0.3 m
STEPS = 15


def house() -> Building:
    """Two storeys of two rooms each, joined by a straight flight of stairs along the west wall; the hole in the slab has a parapet of 0.9 m."""
    x, y, top = 7.0, 6.0, UPPER_M + HEIGHT_M
    footprint = rectangle((0.0, x), (0.0, y))
    planes, faces = shell(footprint, top)
    divide = _doorway(False, (4.0, 4.1), (0.0, y), 2.0)
    solids = [*divide, *(lift_to_upper_floor(solid) for solid in _doorway(False, (4.0, 4.1), (0.0, y), 4.2))]
    hole = ((0.0, 1.1), (0.9, 4.5))
    solids += [*slab_around((0.0, x), (0.0, y), hole), *flight((0.0, 1.0), (0.6, hole[1][1]))]
    solids += [box((1.1, 1.14), (0.9, 4.5), (UPPER_M, UPPER_M + 0.9), "plastic"), box((0.0, 1.14), (0.86, 0.9), (UPPER_M, UPPER_M + 0.9), "plastic")]
    south, east, north, west = walls_of(footprint)
    solids += furniture_along(south, "cabinet 2.4, picture 2.4, sofa 5.6, picture 5.6") + furniture_along(east, "shelf 1.5, picture 3.2, desk 4.8")
    solids += furniture_along(north, "locker 1.2, picture 2.4, portrait 4.4, picture 5.8") + furniture_along(west, "portrait 0.8")
    solids += [lift_to_upper_floor(solid) for solid in furniture_along(south, "picture 2.2, portrait 3.2, desk 5.6, picture 5.6")]
    solids += [
        lift_to_upper_floor(solid)
        for solid in furniture_along(east, "picture 1.2, shelf 3.0, portrait 4.8") + furniture_along(west, "portrait 0.6, picture 3.4")
    ]
    solids += [lift_to_upper_floor(solid) for solid in furniture_along(north, "cabinet 1.4, picture 1.4, picture 4.6, portrait 6.2")]
    low, low_lights = lamps_at([(2.5, 3.0), (5.5, 3.0)])
    high, high_lights = lamps_at([(2.5, 3.0), (5.5, 3.0)], top)
    room = Room(planes, faces, (*solids, *low, *high), (*low_lights, *high_lights), DETAIL, ((0.0, HEIGHT_M), (UPPER_M, top)))
    ground = [(2.0, 3.6), (2.6, 5.0), (3.2, 3.6), (3.4, 2.0), (4.7, 2.0), (5.8, 1.5), (6.1, 3.6), (5.2, 4.6), (4.7, 2.0), (3.4, 2.0), (2.4, 1.2)]
    upper = [(1.6, 5.2), (3.2, 4.2), (4.9, 4.2), (6.0, 4.8), (6.0, 2.2), (5.2, 1.2), (4.9, 4.2), (3.2, 4.2), (3.0, 1.6), (1.9, 1.2), (1.8, 4.4)]
    path = [*ground, (0.5, 0.35), (0.5, 0.6), (0.5, 4.5), (0.5, 5.1), *upper, (0.5, 5.1), (0.5, 4.5), (0.5, 0.6), (0.5, 0.35), (1.9, 0.6)]
    floors = [0.0] * (len(ground) + 2) + [UPPER_M] * (len(upper) + 4) + [0.0] * 3
    return Building(room, Walk(tuple(path), 0.55, 0.5, tuple(floors)))


def storeys() -> Building:
    """Two storeys with the same two rooms, joined by stairs: but for these, and the light on low furniture, one storey looks as the other.
    The walk goes round both."""
    x, y, top = 7.0, 6.0, UPPER_M + HEIGHT_M
    footprint = rectangle((0.0, x), (0.0, y))
    planes, faces = shell(footprint, top)
    south, east, north, west = walls_of(footprint)
    storey = _doorway(False, (4.0, 4.1), (0.0, y), 2.6)
    storey += [wall.mount_box(wall.length_m / 2.0, (0.0, HEIGHT_M), wall.length_m, 0.02, "wall") for wall in (south, east, north, west)]
    for part in ((1.14, 4.0), (4.1, x)):
        storey += [box(part, (0.0, y), (0.0, 0.004), "floor"), box(part, (0.0, y), (HEIGHT_M - 0.004, HEIGHT_M), "ceiling")]
    storey += furniture_along(south, "cabinet 2.4, picture 2.4, sofa 5.6, picture 5.6") + furniture_along(west, "portrait 0.6, picture 3.4")
    storey += furniture_along(east, "shelf 1.5, picture 3.2, desk 4.8") + furniture_along(north, "locker 1.2, picture 2.4, portrait 4.4, picture 5.8")
    hanging, lights = lamps_at([(2.5, 3.0), (5.5, 3.0)])
    storey = [_looking(solid, number) for number, solid in enumerate([*storey, *hanging])]
    hole = ((0.0, 1.1), (0.9, 4.5))
    solids = [*storey, *map(lift_to_upper_floor, storey), *slab_around((0.0, x), (0.0, y), hole), *flight((0.0, 1.0), (0.6, hole[1][1]))]
    solids += [box((1.1, 1.14), (0.9, 4.5), (UPPER_M, UPPER_M + 0.9), "plastic"), box((0.0, 1.14), (0.86, 0.9), (UPPER_M, UPPER_M + 0.9), "plastic")]
    room = Room(planes, faces, tuple(solids), (*lights, *((a, b, c + UPPER_M) for a, b, c in lights)), DETAIL, ((0.0, HEIGHT_M), (UPPER_M, top)))
    tour = [(1.8, 4.8), (3.2, 2.6), (4.9, 2.6), (5.8, 1.5), (6.1, 3.6), (5.2, 4.6), (4.9, 2.6), (3.2, 2.6)]
    path = [*tour, (2.0, 1.2), (0.5, 0.35), (0.5, 0.6), (0.5, 4.5), (0.5, 5.1), *tour, (2.2, 4.4)]
    path += [(0.5, 5.1), (0.5, 4.5), (0.5, 0.6), (0.5, 0.35), (1.9, 0.8)]
    floors = [0.0] * (len(tour) + 3) + [UPPER_M] * (len(tour) + 5) + [0.0] * 3
    return Building(room, Walk(tuple(path), 0.55, 0.5, tuple(floors)))


def slab_around(x: tuple[float, float], y: tuple[float, float], hole: tuple[tuple[float, float], tuple[float, float]]) -> list[Solid]:
    """The slab under the upper floor, ceiling below and floor above, but for a hole (x, y)."""
    (west, east), (south, north) = hole
    solids = list[Solid]()
    for part in (((east, x[1]), y), ((x[0], west), y), ((west, east), (y[0], south)), ((west, east), (north, y[1]))):
        if all(end > begin for begin, end in part):
            solids += [box(*part, (HEIGHT_M, UPPER_M - 0.004), "ceiling"), box(*part, (UPPER_M - 0.004, UPPER_M), "floor")]
    return solids


def flight(x: tuple[float, float], y: tuple[float, float]) -> list[Solid]:
    """A straight flight of stairs that climbs along y from the ground to the upper floor, open below."""
    rise, going = UPPER_M / STEPS, (y[1] - y[0]) / STEPS
    begins = [y[0] + going * step for step in range(STEPS - 1)]
    return [box(x, (y0, y0 + going), (max(rise * (k - 1), 0.0), rise * (k + 1)), "wood") for k, y0 in enumerate(begins)]


def lift_to_upper_floor(solid: Solid) -> Solid:
    """Return a solid as it stands on the upper floor."""
    shift = UPPER_M * UP
    return replace(solid, centre=solid.centre + shift, faces=tuple(replace(face, origin=face.origin + shift) for face in solid.faces))


def _office(west: float) -> list[Solid]:
    """A room of 4 × 4 m north of a corridor, with its own floor and ceiling: one office looks as any other to the last texel."""
    x, y = (west, west + 4.0), (2.1, 6.1)
    solids = _doorway(True, (2.0, 2.1), (x[0] - WALL_M, x[1] + WALL_M), west + 2.0)
    solids += [box(side, (2.1, 6.2), (0.0, HEIGHT_M), "wall") for side in ((x[0] - WALL_M, x[0]), (x[1], x[1] + WALL_M))]
    solids += [box(x, (6.1, 6.2), (0.0, HEIGHT_M), "wall")]
    solids += [box(x, y, (0.0, 0.004), "floor"), box(x, y, (HEIGHT_M - 0.004, HEIGHT_M), "ceiling")]
    south, to_east, north, to_west = walls_of(rectangle(x, y))
    solids += furniture_along(south, "portrait 0.8, bin 3.6") + furniture_along(to_east, "shelf 1.5, picture 3.1")
    solids += furniture_along(north, "desk 1.4, window 1.4, globe 3.2") + furniture_along(to_west, "picture 1.0, sofa 2.7")
    return [_looking(solid, number) for number, solid in enumerate(solids)]


def _looking(solid: Solid, number: int) -> Solid:
    """The solid with its faces' textures named, so that another of the same number has the same."""
    return replace(solid, faces=tuple(replace(face, look=8 * number + k) for k, face in enumerate(solid.faces)))


def offices() -> Building:
    """Two identical offices on one corridor; the walk visits one, then the other, and returns to where it began."""
    x, first, second = 14.0, 1.6, 8.4
    gaps = ((0.0, first - WALL_M), (first + 4.0 + WALL_M, second - WALL_M), (second + 4.0 + WALL_M, x))
    blocks = [box(gap, (2.0, 6.2), (0.0, HEIGHT_M), "wall") for gap in gaps]
    south, east, _, west = walls_of(rectangle((0.0, x), (0.0, 2.0)))
    solids = [*blocks, *_office(first), *_office(second), _skirting(south), _skirting(east), _skirting(west)]
    solids += furniture_along(south, "door 1.2, picture 2.7, portrait 4.4, door 6.0, picture 7.4, door 9.4, portrait 10.6, picture 11.8, door 13.2")
    solids += furniture_along(east, "window 1.0") + furniture_along(west, "picture 1.0")
    lamps = [(3.6, 1.0), (10.4, 1.0), (7.0, 1.0), (first + 2.0, 4.1), (second + 2.0, 4.1)]
    path = [(2.2, 0.85)]
    for door in (first + 2.0, second + 2.0):
        inside = [(door, 3.1), (door + 0.8, 3.7), (door + 0.6, 4.7), (door - 0.6, 4.7), (door - 0.8, 3.7), (door, 3.1)]
        path += [(door, 0.85), *inside, (door, 0.85)]
    path += [(12.8, 0.85), (12.8, 1.2), (1.0, 1.2), (1.0, 0.85)]
    return _building(x, 6.2, solids, lamps, Walk(tuple(path), 0.7, 1.1))


ROOMS = (  # south row from west to east: plans of the outer, the east, the inner and the west wall; then the north row
    ("cabinet 1.0, window 2.9", "picture 1.0", "picture 1.3", "portrait 1.4, bin 3.4"),
    ("shelf 1.2, shelf 2.9, picture 4.1", "portrait 1.1", "window 2.3", "portrait 2.9"),
    ("desk 1.2, window 1.2, locker 3.4", "crates 0.5", "pilaster 1.0, picture 3.4", "picture 2.9"),
    ("sofa 2.3, picture 2.3", "locker 0.6", "portrait 1.1, door 3.3", "bin 3.7"),
    ("globe 1.0, shelf 3.2", "desk 1.1, picture 2.6", "picture 3.1", "portrait 3.2"),
    ("window 1.2, sofa 3.2", "portrait 3.2", "picture 2.2", "door 1.6, crates 3.2"),
    ("desk 1.0, desk 3.4, picture 2.2", "picture 3.1", "portrait 1.5, door 3.5", "crates 0.6"),
    ("pilaster 0.9, cabinet 2.3, pilaster 3.7", "bin 3.6", "picture 1.2, window 3.2", "portrait 1.0"),
    ("shelf 0.9, crates 2.4, locker 3.8", "portrait 3.4", "door 1.4, picture 3.4", "picture 0.9"),
    ("sofa 1.4, globe 3.5", "window 1.3, bench 3.0", "picture 1.5", "portrait 0.9"),
)
ROOM_M = (4.6, 4.0)


def rooms() -> Building:
    """Ten different rooms in two rows of five, joined by doorways to a circuit."""
    (width, depth), pitch = ROOM_M, ROOM_M[0] + WALL_M
    x, y = 5 * pitch - WALL_M, 2 * depth + WALL_M
    middle, doors = (depth, depth + WALL_M), (2.5, y - 2.5)
    openings = (1.2, x - 1.2)  # in the wall between the rows, at its two ends
    solids = [*_doorway(True, middle, (0.0, 5.0), openings[0]), *_doorway(True, middle, (x - 5.0, x), openings[1])]
    solids.append(box((5.0, x - 5.0), middle, (0.0, HEIGHT_M), "wall"))
    for row, at in enumerate(doors):
        span = (0.0, depth) if row == 0 else (depth + WALL_M, y)
        for k in range(1, 5):
            solids += _doorway(False, (k * pitch - WALL_M, k * pitch), span, at)
    for number, plans in enumerate(ROOMS):
        row, k = divmod(number, 5)
        south, east, north, west = walls_of(rectangle((k * pitch, k * pitch + width), (row * (depth + WALL_M), row * (depth + WALL_M) + depth)))
        sides = (south, east, north, west) if row == 0 else (north, east, south, west)  # the furniture stands along the outer wall
        for wall, plan in zip(sides, plans):
            solids += furniture_along(wall, plan)
    centres = [(k * pitch + width / 2.0, at) for at in (2.0, y - 2.0) for k in range(5)]
    return _building(x, y, solids, centres, Walk(_circuit(pitch, doors, openings), 0.62, 0.6))


def _circuit(pitch: float, doors: tuple[float, float], openings: tuple[float, float]) -> tuple[tuple[float, float], ...]:
    """East through the south row, west through the north row, with a bow in every room."""
    there, back = [], []
    for k in range(5):
        left, right, centre = k * pitch + 0.5, (k + 1) * pitch - 0.6, (k + 0.5) * pitch
        bow = 0.45 if k % 2 else 0.9
        there += [(left, doors[0]), (centre, doors[0] - bow), (right, doors[0])]
        back += [(left, doors[1]), (centre, doors[1] + bow), (right, doors[1])]
    there[0], there[-1] = (openings[0], 2.2), (openings[1], 2.2)
    back[0], back[-1] = (openings[0], doors[1] + 0.3), (openings[1], doors[1] + 0.3)
    return (*there, *back[::-1])
