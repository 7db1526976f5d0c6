"""Flats by number: rooms, doors and furniture drawn at random, and the walk that shows every room. Metres, z up.

What plans get wrong stands in them: wardrobes of 1.8 m to 2.4 m, shelves, curtains, niches, radiators, columns and half-open doors."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from trihedron.datasets.simulation.buildings import (
    DETAIL,
    DOORWAY_M,
    UPPER_M,
    Building,
    flight,
    lamps_at,
    lift_to_upper_floor,
    rectangle,
    slab_around,
    wall_with_gaps,
)
from trihedron.datasets.simulation.furniture import PIECES, furniture_along
from trihedron.datasets.simulation.motion import Sway
from trihedron.datasets.simulation.room import HEIGHT_M, UP, Room, Solid, Wall, box, shell, turned_box, walls_of
from trihedron.datasets.simulation.walks import Walk
from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.types import F64

JAMB_M = 0.35  # least distance of a door from the end of its wall
CLEAR_M = 0.3  # of furniture from the path
AISLE_M = 2.2  # a narrower room is walked along its middle
STEP_M = 0.6  # before and behind a door, where the path is square to it
SPEED_M_S, LOOK_AHEAD_M = 0.5, 0.5
GAZE_DEG = Sway((14.0, 10.0, 2.0), (7.3, 5.7, 4.9))  # yaw, pitch, roll: who scans a flat looks up and down
LEAST_SHARED_M = DOORWAY_M[0] + 2.0 * JAMB_M  # of a wall between two rooms, for a door


@dataclass(frozen=True)
class _Door:
    """A doorway between rooms `a` and `b`: its middle (2,), the unit direction (2,) from a to b, the thickness of its wall."""

    a: int
    b: int
    middle: F64
    across: F64
    depth_m: float


@dataclass
class _Partition:
    """A wall between rooms, from `start` to `end` along its middle line, and the middles of its doors along it."""

    start: tuple[float, float]
    end: tuple[float, float]
    depth_m: float
    doors: list[float] = field(default_factory=list)

    @property
    def is_level(self) -> bool:
        """Say if it runs along x."""
        return self.start[1] == self.end[1]


Rectangle = tuple[float, float, float, float]  # west, east, south, north


def random_flat(number: int) -> Building:
    """Make flat `number`: 7 m to 11 m by 6 m to 9 m, three to six rooms in two blocks or along a corridor."""
    rng = np.random.default_rng([number, 41])
    width, depth = _between(rng, 7.5, 10.5), _between(rng, 6.2, 8.6)
    rooms, partitions = (_corridor_plan if rng.uniform() < 0.35 else _block_plan)(rng, width, depth)
    return _furnished(rng, (width, depth), rooms, partitions, _doors(rng, rooms, partitions))


def whole_floor() -> Building:
    """Make a floor of eight furnished rooms along a corridor of 20 m, and a stairwell at its end with two more rooms upstairs; the walk goes through
    all of them and comes back to where it began."""
    rng = np.random.default_rng([0, 43])
    width, depth = 20.0, 11.6
    rooms, partitions = _floor_plan(rng, width, depth)
    doors = _all_doors(rng, rooms, partitions)
    north, south = (sorted((door for door in doors if (door.a == 0) == there), key=lambda door: float(door.middle[0])) for there in (True, False))
    stairs_rng = np.random.default_rng([1, 43])
    rooms, partitions = [*rooms, _AISLE], [*partitions, _Partition((width + 0.05, 0.0), (width + 0.05, depth), 0.1)]
    to_stairs = [_hang_door(stairs_rng, shared) for shared in _shared_walls(rooms, partitions) if (shared.a, shared.b) == (0, len(rooms) - 1)]
    doors = [*north, *to_stairs, *south[::-1]]
    around = _path(rooms, doors)
    solids = _interior(rng, (width, depth), rooms[:-1], partitions, doors, around)

    upper_rooms, upper_partitions = _upper_plan(stairs_rng, width, depth)
    upper_doors = _doors(stairs_rng, upper_rooms, upper_partitions)
    upstairs = _path(upper_rooms, upper_doors, len(upper_rooms) - 1, np.array(_HEAD))
    above = _interior(stairs_rng, (width, depth), upper_rooms[:-1], upper_partitions, upper_doors, upstairs)
    solids += [*map(lift_to_upper_floor, above), *_stairwell(width, depth)]
    top = UPPER_M + HEIGHT_M
    planes, faces = shell(rectangle((0.0, _STAIRWELL[1]), (0.0, depth)), top)
    lamps, lights = lamps_at([_middle(room) for room in rooms])
    upper_lamps, upper_lights = lamps_at([_middle(room) for room in upper_rooms], top)
    room = Room(planes, faces, (*solids, *lamps, *upper_lamps), (*lights, *upper_lights), DETAIL, ((0.0, HEIGHT_M), (UPPER_M, top)))
    return Building(room, _climb(around, upstairs))


_STAIRWELL = (20.1, 23.4, 0.0, 7.2)  # at the end of the corridor
_AISLE = (20.1, 22.2, 0.0, 7.2)  # of it, beside the stairs
_HOLE = ((22.3, 23.4), (1.2, 4.9))  # in the slab: x, y
_FOOT, _HEAD = (22.9, 0.7), (22.9, 5.6)  # before and behind the flight


def _upper_plan(rng: np.random.Generator, width: float, depth: float) -> tuple[list[Rectangle], list[_Partition]]:
    """Lay two rooms over the east end of the floor, beside the landing, which comes last."""
    west, cut = 14.6, _Partition((14.6, level := _between(rng, 0.4 * depth, 0.46 * depth)), (width, level), _thickness(rng))
    rooms = [(west, width, 0.0, level - cut.depth_m / 2.0), (west, width, level + cut.depth_m / 2.0, depth), _AISLE]
    return rooms, [cut, _Partition((width + 0.05, 0.0), (width + 0.05, depth), 0.1)]


def _stairwell(width: float, depth: float) -> list[Solid]:
    """Build the stairs, the slab between the storeys, and what no room is made of on either; hang pictures."""
    (west, east), (south, north) = _HOLE
    solids = [box((width + 0.1, _STAIRWELL[1]), (_STAIRWELL[3], depth), (0.0, HEIGHT_M), "wall")]
    solids.append(lift_to_upper_floor(solids[0]))
    solids.append(lift_to_upper_floor(box((0.0, 14.6), (0.0, depth), (0.0, HEIGHT_M), "wall")))
    solids += [*slab_around((0.0, east), (0.0, depth), _HOLE), *flight((west + 0.1, east), (_FOOT[1] + 0.5, north))]
    parapet = (UPPER_M, UPPER_M + 0.9)
    solids += [box((west - 0.04, west), (south, north), parapet, "plastic"), box((west - 0.04, east), (south - 0.04, south), parapet, "plastic")]
    to_south, to_east, to_north, to_west = walls_of(rectangle(_STAIRWELL[:2], _STAIRWELL[2:]))
    solids += furniture_along(to_south, "picture 1.2, portrait 2.7") + furniture_along(to_north, "portrait 0.6, locker 1.8, picture 2.8")
    solids += furniture_along(to_west, "portrait 3.0, picture 4.4, portrait 6.0") + furniture_along(to_east, "picture 6.0")
    upper = furniture_along(to_south, "portrait 0.7, picture 2.3") + furniture_along(to_north, "picture 0.8, cabinet 2.2, portrait 2.2")
    return solids + [lift_to_upper_floor(solid) for solid in upper + furniture_along(to_east, "picture 1.9, portrait 3.4, picture 4.8, portrait 6.3")]


def _climb(around: tuple[tuple[float, float], ...], upstairs: tuple[tuple[float, float], ...]) -> Walk:
    """Walk a closed path of the ground floor and, from where it is next to the stairs, up and round the upper floor."""
    near = int(np.argmin([norm(np.subtract(point, _FOOT)) for point in around])) + 1
    begin, end = (_FOOT[0], _FOOT[1] + 0.5), (_HEAD[0], _HOLE[1][1])  # of the flight
    path = [*around[:near], _FOOT, begin, end, _HEAD, *upstairs, upstairs[0], _HEAD, end, begin, _FOOT, *around[near - 1 :]]
    floors = [0.0] * (near + 2) + [UPPER_M] * (len(upstairs) + 5) + [0.0] * (len(around) - near + 3)
    return Walk(tuple(path), SPEED_M_S, LOOK_AHEAD_M, tuple(floors), GAZE_DEG)


def _furnished(
    rng: np.random.Generator, size: tuple[float, float], rooms: list[Rectangle], partitions: list[_Partition], doors: list[_Door]
) -> Building:
    """Make a flat of one storey, and walk through its rooms."""
    width, depth = size
    path = _path(rooms, doors)
    solids = _interior(rng, size, rooms, partitions, doors, path)
    planes, faces = shell(rectangle((0.0, width), (0.0, depth)))
    hanging, lights = lamps_at([_middle(room) for room in rooms])
    return Building(Room(planes, faces, (*solids, *hanging), lights, DETAIL), Walk(path, SPEED_M_S, LOOK_AHEAD_M, gaze_deg=GAZE_DEG))


def _interior(
    rng: np.random.Generator,
    size: tuple[float, float],
    rooms: list[Rectangle],
    partitions: list[_Partition],
    doors: list[_Door],
    path: tuple[tuple[float, float], ...],
) -> list[Solid]:
    """Return the walls between rooms, and niches, furniture and door leaves that leave a path free."""
    solids = [solid for wall in partitions for solid in _partition_solids(wall)]
    for room in rooms:
        solids += _niche(rng, room, size, path) if rng.uniform() < 0.3 else []
    for number_of_room, room in enumerate(rooms):
        solids += _furniture(rng, room, [door for door in doors if number_of_room in (door.a, door.b)], path, solids)
    return solids + [solid for door in doors if rng.uniform() < 0.4 for solid in _leaf(rng, door, path)]


def _middle(room: Rectangle) -> tuple[float, float]:
    west, east, south, north = room
    return (west + east) / 2.0, (south + north) / 2.0


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a length in whole centimetres."""
    return round(float(rng.uniform(low, high)), 2)


def _thickness(rng: np.random.Generator) -> float:
    return float(rng.choice([0.08, 0.1, 0.12, 0.16]))


def _block_plan(rng: np.random.Generator, width: float, depth: float) -> tuple[list[Rectangle], list[_Partition]]:
    """Cut the flat into a west and an east block, and each, or one, into two rooms."""
    middle, rooms = _between(rng, 0.42 * width, 0.58 * width), list[Rectangle]()
    walls = [_Partition((middle, 0.0), (middle, depth), _thickness(rng))]
    half = walls[0].depth_m / 2.0
    whole = int(rng.integers(3))  # this block stays one room; 2 = none does
    for block, (west, east) in enumerate(((0.0, middle - half), (middle + half, width))):
        if block == whole:
            rooms.append((west, east, 0.0, depth))
            continue
        cut = _Partition((west, level := _between(rng, 0.4 * depth, 0.6 * depth)), (east, level), _thickness(rng))
        walls.append(cut)
        rooms += [(west, east, 0.0, level - cut.depth_m / 2.0), (west, east, level + cut.depth_m / 2.0, depth)]
    return rooms, walls


def _corridor_plan(rng: np.random.Generator, width: float, depth: float) -> tuple[list[Rectangle], list[_Partition]]:
    """Lay a corridor from west to east, with two rooms on its north side and one or two on its south side."""
    low = _between(rng, 0.38 * depth, 0.44 * depth)
    high = low + _between(rng, 1.4, 1.7)
    south, north = _Partition((0.0, low), (width, low), _thickness(rng)), _Partition((0.0, high), (width, high), _thickness(rng))
    rooms, walls = [(0.0, width, low + south.depth_m / 2.0, high - north.depth_m / 2.0)], [south, north]
    for bottom, top, parted in ((high + north.depth_m / 2.0, depth, True), (0.0, low - south.depth_m / 2.0, rng.uniform() < 0.6)):
        if not parted:
            rooms.append((0.0, width, bottom, top))
            continue
        cut = _Partition((at := _between(rng, 0.4 * width, 0.6 * width), bottom), (at, top), _thickness(rng))
        walls.append(cut)
        rooms += [(0.0, at - cut.depth_m / 2.0, bottom, top), (at + cut.depth_m / 2.0, width, bottom, top)]
    return rooms, walls


def _floor_plan(rng: np.random.Generator, width: float, depth: float) -> tuple[list[Rectangle], list[_Partition]]:
    """Lay a corridor from west to east, with four rooms on each side."""
    low = _between(rng, 0.42 * depth, 0.44 * depth)
    high = low + 1.8
    south, north = _Partition((0.0, low), (width, low), _thickness(rng)), _Partition((0.0, high), (width, high), _thickness(rng))
    rooms, walls = [(0.0, width, low + south.depth_m / 2.0, high - north.depth_m / 2.0)], [south, north]
    for bottom, top in ((high + north.depth_m / 2.0, depth), (0.0, low - south.depth_m / 2.0)):
        west = 0.0
        for number in range(4):
            if number == 3:
                rooms.append((west, width, bottom, top))
                continue
            at = _between(rng, (number + 0.9) * width / 4.0, (number + 1.1) * width / 4.0)
            walls.append(_Partition((at, bottom), (at, top), _thickness(rng)))
            rooms.append((west, at - walls[-1].depth_m / 2.0, bottom, top))
            west = at + walls[-1].depth_m / 2.0
    return rooms, walls


def _doors(rng: np.random.Generator, rooms: list[Rectangle], partitions: list[_Partition]) -> list[_Door]:
    """Join the rooms by doors: as many as reach all of them, and one more in some flats. They are added to their walls."""
    possible = _shared_walls(rooms, partitions)
    found, joined, spare = list[_Door](), {0}, rng.uniform() < 0.3
    order = [possible[k] for k in rng.permutation(len(possible))]
    while True:
        reaching = [item for item in order if (item.a in joined) != (item.b in joined)]
        more = [item for item in order if not any({item.a, item.b} == {door.a, door.b} for door in found)]
        chosen = reaching[0] if reaching else more[0] if spare and more else None
        if chosen is None:
            return found
        spare = spare and bool(reaching)
        found.append(_hang_door(rng, chosen))
        joined |= {chosen.a, chosen.b}


def _all_doors(rng: np.random.Generator, rooms: list[Rectangle], partitions: list[_Partition]) -> list[_Door]:
    """Join every room to the first by a door."""
    return [_hang_door(rng, shared) for shared in _shared_walls(rooms, partitions) if 0 in (shared.a, shared.b)]


@dataclass(frozen=True)
class _Shared:
    """The stretch `low` to `high` of a wall across `axis` (0 = x) that has room `a` before it and `b` behind it."""

    a: int
    b: int
    wall: _Partition
    axis: int
    low: float
    high: float


def _shared_walls(rooms: list[Rectangle], partitions: list[_Partition]) -> list[_Shared]:
    """Return the walls between two rooms that are long enough for a door."""
    found = []
    for a in range(len(rooms)):
        for b in range(len(rooms)):
            for wall in partitions:
                axis = 1 if wall.is_level else 0
                line, near = wall.start[axis], wall.depth_m / 2.0 + 1e-6
                if abs(rooms[a][2 * axis + 1] - line) > near or abs(rooms[b][2 * axis] - line) > near:
                    continue
                other = 2 * (1 - axis)
                low, high = max(rooms[a][other], rooms[b][other]), min(rooms[a][other + 1], rooms[b][other + 1])
                if high - low >= LEAST_SHARED_M:
                    found.append(_Shared(a, b, wall, axis, low, high))
    return found


def _hang_door(rng: np.random.Generator, shared: _Shared) -> _Door:
    """Make a door at a random place of a shared wall, which gets a gap there."""
    at = _between(rng, shared.low + LEAST_SHARED_M / 2.0, shared.high - LEAST_SHARED_M / 2.0)
    across = np.eye(2)[shared.axis]
    shared.wall.doors.append(at - shared.wall.start[1 - shared.axis])
    return _Door(shared.a, shared.b, across * shared.wall.start[shared.axis] + np.eye(2)[1 - shared.axis] * at, across, shared.wall.depth_m)


def _partition_solids(wall: _Partition) -> list[Solid]:
    return wall_with_gaps(wall.start, wall.end, [(at, DOORWAY_M[0], 0.0, DOORWAY_M[1]) for at in wall.doors], wall.depth_m)


def _path(rooms: list[Rectangle], doors: list[_Door], first: int = 0, entry: F64 | None = None) -> tuple[tuple[float, float], ...]:
    """Walk through all rooms by their doors and back, round each room once, beginning in room `first` where it is nearest to `entry` (2,)."""
    points, seen = list[F64](), set[int]()

    def visit(room: int) -> None:
        seen.add(room)
        tour = _tour(rooms[room], points[-1] if points else np.zeros(2) if entry is None else entry)
        points.extend(tour)
        for door in doors:
            if room in (door.a, door.b) and (other := door.a + door.b - room) not in seen:
                ahead = door.across * (1.0 if room == door.a else -1.0) * (STEP_M + door.depth_m / 2.0)
                points.extend([door.middle - ahead, door.middle + ahead])
                visit(other)
                points.extend([door.middle + ahead, door.middle - ahead])
        points.append(tour[0] * 0.98 + 0.02 * tour[1])

    visit(first)
    apart = [p for p, q in pairwise([*points, points[0]]) if norm(q - p) > 0.05]
    return tuple((float(x), float(y)) for x, y in apart)


def _tour(room: Rectangle, entry: F64) -> list[F64]:
    """Return way-points (2,) round a room, the nearest to where it is entered first; a narrow room is walked along its middle."""
    west, east, south, north = room
    if north - south < AISLE_M or east - west < AISLE_M:
        x, y = (west + east) / 2.0, (south + north) / 2.0
        ends = (
            [np.array([west + 0.9, y]), np.array([east - 0.9, y])]
            if east - west > north - south
            else [np.array([x, south + 0.9]), np.array([x, north - 0.9])]
        )
        return sorted(ends, key=lambda p: float(norm(p - entry)))
    x_in, y_in = min(1.25, 0.36 * (east - west)), min(1.25, 0.36 * (north - south))
    ring = [np.array(p) for p in rectangle((west + x_in, east - x_in), (south + y_in, north - y_in))]
    first = int(np.argmin([norm(p - entry) for p in ring]))
    return [*ring[first:], *ring[:first]]


def _free(solid: Solid, path: Any, taken: list[Any]) -> bool:
    """Say if a solid stands off the path and overlaps no other on the plan; then it is added to `taken`."""
    import shapely

    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * solid.half[:2]
    outline = shapely.Polygon(matmul(corners, solid.R_world_solid[:2, :2].T) + solid.centre[:2])
    if outline.distance(path) < CLEAR_M or any(outline.distance(other) < 0.05 for other in taken):
        return False
    taken.append(outline)
    return True


def _niche(rng: np.random.Generator, room: Rectangle, size: tuple[float, float], path: tuple[tuple[float, float], ...]) -> list[Solid]:
    """Fill the outer wall of a room by 0.3 m but for a niche, where that leaves the path free."""
    import shapely

    (west, east, south, north), (width, depth) = room, size
    sides = [side for side, at_shell in enumerate((south == 0.0, east == width, north == depth, west == 0.0)) if at_shell]
    wall = walls_of(rectangle((west, east), (south, north)))[int(rng.choice(sides))]
    wide, deep = _between(rng, 1.0, 1.6), 0.3
    at = _between(rng, 0.6 + wide / 2.0, max(wall.length_m - 0.6 - wide / 2.0, 0.61 + wide / 2.0))
    parts = [(0.0, at - wide / 2.0), (at + wide / 2.0, wall.length_m)]
    solids = [wall.mount_box((a + b) / 2.0, (0.0, HEIGHT_M), b - a, deep, "wall") for a, b in parts if b - a > 0.3]
    line = shapely.LineString([*path, path[0]])
    return solids if len(solids) == 2 and all(_free(solid, line, []) for solid in solids) else []


WEIGHTS = {"wardrobe": 3, "tall_shelf": 1, "shelf": 2, "curtain": 1, "radiator": 1, "cabinet": 2, "desk": 1, "sofa": 1, "locker": 1, "column": 1}
ON_WALLS = ("picture", "portrait", "picture", "portrait", "window")


def _furniture(
    rng: np.random.Generator, room: Rectangle, doors: list[_Door], path: tuple[tuple[float, float], ...], walls: list[Solid]
) -> list[Solid]:
    """Furnish a room along its walls, clear of doors and path; what is free of the walls has pictures."""
    import shapely

    line, doorways = shapely.LineString([*path, path[0]]), [shapely.Point(door.middle).buffer(0.75) for door in doors]
    west, east, south, north = room
    inner = [solid for solid in walls if _is_within(solid, room)]
    taken = [*doorways, *(shapely.Point(solid.centre[:2]).buffer(float(norm(solid.half[:2]))).envelope for solid in inner)]
    found: list[Solid] = []
    for wall in walls_of(rectangle((west, east), (south, north))):
        for _ in range(2 if wall.length_m > 2.5 else 1):
            name = str(rng.choice(list(WEIGHTS), p=np.array(list(WEIGHTS.values())) / sum(WEIGHTS.values())))
            at = _between(rng, 0.2, wall.length_m - 0.2)
            pieces = _piece(rng, name, wall, at)
            fits = all(_is_within(solid, room) for solid in pieces)
            if fits and _free(max(pieces, key=lambda solid: float(solid.half[0] * solid.half[1])), line, taken):
                found += pieces
        spots = np.arange(0.6, wall.length_m - 0.5, 1.1)
        for at in spots:
            pieces = PIECES[str(rng.choice(ON_WALLS))](wall, float(at) + _between(rng, -0.15, 0.15))
            outline = shapely.box(*_bounds(pieces))
            if all(_is_within(solid, room) for solid in pieces) and not any(outline.intersects(other) for other in taken):
                found += pieces
                taken.append(outline)
    return found


def _bounds(solids: list[Solid]) -> tuple[float, float, float, float]:
    """Return west, south, east and north of solids that are square to the axes."""
    half = np.array([matmul(np.abs(solid.R_world_solid[:2, :2]), solid.half[:2]) for solid in solids])
    centre = np.array([solid.centre[:2] for solid in solids])
    low, high = (centre - half).min(axis=0), (centre + half).max(axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _is_within(solid: Solid, room: Rectangle) -> bool:
    west, south, east, north = _bounds([solid])
    return room[0] - 1e-6 <= west and east <= room[1] + 1e-6 and room[2] - 1e-6 <= south and north <= room[3] + 1e-6


def _piece(rng: np.random.Generator, name: str, wall: Wall, at: float) -> list[Solid]:
    """Return a piece of furniture of random size at a place along a wall."""
    if name == "wardrobe":
        return [wall.mount_box(at, (0.0, _between(rng, 1.8, 2.4)), _between(rng, 0.9, 2.2), _between(rng, 0.5, 0.65), "wood", "drawers")]
    if name == "tall_shelf":
        return [wall.mount_box(at, (0.0, _between(rng, 1.9, 2.3)), _between(rng, 0.8, 1.6), 0.3, "paper", "books")]
    if name == "curtain":
        return [wall.mount_box(at, (0.02, 2.45), _between(rng, 0.9, 1.8), 0.06, "fabric", off_m=0.08)]
    if name == "radiator":
        return [wall.mount_box(at, (0.12, 0.72), _between(rng, 0.8, 1.4), 0.1, "plastic", off_m=0.04)]
    if name == "column":
        return [wall.mount_box(at, (0.0, HEIGHT_M), 0.35, 0.35, "wall")]
    return PIECES[name](wall, at)


def _leaf(rng: np.random.Generator, door: _Door, path: tuple[tuple[float, float], ...]) -> list[Solid]:
    """Hang a door that stands open by 60° to 110° in a doorway, on a side where nobody runs into it."""
    import shapely

    line = shapely.LineString([*path, path[0]])
    along, opened, wide = np.array([-door.across[1], door.across[0]]), float(np.radians(rng.uniform(60.0, 110.0))), DOORWAY_M[0] - 0.06
    for side, into in ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
        hinge = door.middle + side * along * (DOORWAY_M[0] / 2.0 - 0.02) + into * door.across * (door.depth_m / 2.0 + 0.02)
        leaf = -side * np.cos(opened) * along + into * np.sin(opened) * door.across
        if shapely.LineString([hinge, hinge + wide * leaf]).distance(line) > 0.2:
            centre = np.array([*(hinge + wide / 2.0 * leaf), 0.0]) + 1.03 * UP
            return [turned_box(centre, np.array([wide / 2.0, 0.02, 1.02]), float(np.arctan2(leaf[1], leaf[0])), "wood", "door", 3)]
    return []
