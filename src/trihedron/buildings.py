"""The plan of a building, to be asked: storeys, walls, rooms, openings, and distances, each figure with its standard deviation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trihedron.pipeline.core import types
from trihedron.pipeline.core.described import Described
from trihedron.pipeline.core.errors import DataError, UsageError
from trihedron.pipeline.core.linalg import matmul, norm
from trihedron.pipeline.core.plan_areas import area_interval, area_sigma, edge_sigma, seen_share
from trihedron.pipeline.core.types import F64, OPENING_KINDS, Pose
from trihedron.plugins.building.geometry import quad, rings_of
from trihedron.plugins.building.labels import name_of, use_of

if TYPE_CHECKING:
    import shapely

END_SIGMA_M = 0.05  # of where a wall was last seen
PARALLEL_DEG = 5.0  # between walls that have a distance
BELOW_M = 0.3  # below its floor that a storey begins


@dataclass(frozen=True)
class Measurement:
    """A figure with its standard deviation, in the same unit; NaN = not seen."""

    value: float
    sigma: float

    def __float__(self) -> float:
        return self.value

    def __repr__(self) -> str:
        return f"{self.value:.3f} ± {self.sigma:.3f}"


@dataclass(frozen=True)
class Storey:
    """A storey: heights of floor and ceiling in the building's frame, m."""

    number: int
    floor_m: Measurement
    ceiling_m: Measurement


@dataclass(frozen=True)
class Wall(Described):
    """A wall: the ends (2,) of its face, with the side it was seen from on the left; length, thickness and the standard deviation of the face's
    offset, m; the stretches (n, 2) along it that were not seen; its corners (4, 2) on the plans, which draw a wall whose other face was not seen 6 cm
    thick."""

    number: int
    storey: int
    start: F64
    end: F64
    length_m: Measurement
    thickness_m: Measurement
    offset_sigma_m: float
    unseen: F64
    corners: F64
    name: str = ""

    @cached_property
    def outline(self) -> shapely.Polygon:
        """The wall on the plan, openings included."""
        return _polygon(self.corners)

    @property
    def along(self) -> F64:
        """The unit direction (2,) from start to end."""
        return np.asarray((self.end - self.start) / max(float(norm(self.end - self.start)), 1e-9))

    @property
    def normal(self) -> F64:
        """The unit normal (2,) of the face."""
        return np.array([-self.along[1], self.along[0]])


@dataclass(frozen=True)
class Edge(Described):
    """An edge of a room between two corners (2,), with the room on its left; `wall` is None where nothing bounds what was seen."""

    start: F64
    end: F64
    length_m: Measurement
    wall: int | None


@dataclass(frozen=True)
class Room(Described):
    """A room: corners (n, 2) anticlockwise, those of holes the other way, the edges of all, area (m²) and perimeter (m) of the outer ring, the
    numbers of its openings; `closed` if a wall was seen all round. `area_interval_m2` is the 95 % interval of the area, with what may be otherwise
    than the plan has it (furniture or a wall, what no view shows); `seen_share` the share of the outline that was read, 0 to 1."""

    number: int
    storey: int
    corners: F64
    holes: tuple[F64, ...]
    edges: tuple[Edge, ...]
    area_m2: Measurement
    perimeter_m: Measurement
    openings: tuple[int, ...]
    closed: bool
    name: str = ""
    use: str = ""
    area_interval_m2: tuple[float, float] = (0.0, 0.0)
    seen_share: float = 1.0

    @cached_property
    def polygon(self) -> shapely.Polygon:
        """The room on the plan, with its holes."""
        return _polygon(self.corners, self.holes)


@dataclass(frozen=True)
class Opening(Described):
    """A `door`, `passage` or `window` in a wall: middle (3,) in the building's frame, width and height, m, the rooms it joins (None: none), and its
    corners (4, 2) on the plans."""

    number: int
    kind: str
    wall: int
    middle: F64
    width_m: Measurement
    height_m: Measurement
    rooms: tuple[int | None, int | None]
    corners: F64
    name: str = ""

    @cached_property
    def outline(self) -> shapely.Polygon:
        """The stretch of the wall on the plan."""
        return _polygon(self.corners)


class Building:
    """The plan of a building; `plan` is the value as it is recorded. Positions are in the building's frame (`plan.T_world_building`), metres.

    Args:
        plan: as the topic `building` has it.
    """

    def __init__(self, plan: types.Building) -> None:
        self.plan = plan

    @property
    def note(self) -> str:
        """Sentences on what the plan lacks; empty when nothing."""
        return self.plan.note

    @cached_property
    def storeys(self) -> tuple[Storey, ...]:
        """The storeys from the lowest."""
        sigmas = [np.sqrt(np.diag(covariance)) for covariance in self.plan.storey_covariance]
        pairs = [[Measurement(float(value), float(s)) for value, s in zip(heights, sigma)] for heights, sigma in zip(self.plan.storeys, sigmas)]
        return tuple(Storey(number, floor, ceiling) for number, (floor, ceiling) in enumerate(pairs))

    @cached_property
    def walls(self) -> tuple[Wall, ...]:
        """The walls."""
        return tuple(self._wall(k) for k in range(len(self.plan.walls_m)))

    @cached_property
    def rooms(self) -> tuple[Room, ...]:
        """The rooms."""
        return tuple(self._room(k) for k in range(len(self.plan.areas_m2)))

    @cached_property
    def openings(self) -> tuple[Opening, ...]:
        """The doors, passages and windows."""
        return tuple(self._opening(k) for k in range(len(self.plan.spans_m)))

    def room_of(self, pose: Any) -> Room | None:
        """Return the room in which a camera is.

        Args:
            pose: a `Pose`, `T_world_camera` (4, 4) or a point (3,) of the world, m.

        Returns:
            The first room whose outline and heights hold the point; None where none does.

        Raises:
            UsageError: `pose` is no place.
        """
        import shapely

        x, y, z = self._point(pose, "room_of")[0]
        for room in self.rooms:
            floor, ceiling = self.plan.storeys[room.storey]
            within = not z < floor - BELOW_M and not z > ceiling  # NaN: any height
            if within and shapely.contains_xy(room.polygon, x, y):
                return room
        return None

    def distance(self, a: Any, b: Any) -> Measurement:
        """Return the distance of two things, m: of two parallel walls between the faces that face each other, of a wall and a point at right angles
        to its face, of two points in a straight line.

        Args:
            a: a `Wall`, or a point: an `Opening` (its middle), a `Pose`, `T_world_camera` (4, 4) or (3,) of the world, m.
            b: likewise.

        Returns:
            The distance and its standard deviation, m; that of a matrix or of (3,) is taken as exact.

        Raises:
            UsageError: two walls are not parallel, or something is no place.
        """
        if isinstance(a, Wall) and isinstance(b, Wall):
            return _between(a, b)
        if isinstance(b, Wall):
            a, b = b, a
        if isinstance(a, Wall):
            point, covariance = self._point(b, "distance")
            normal = np.array([*a.normal, 0.0])
            sigma = np.sqrt(a.offset_sigma_m**2 + float(matmul(normal, covariance, normal)))
            return Measurement(abs(float(matmul(point[:2] - a.start, a.normal))), float(sigma))
        (p, first), (q, second) = self._point(a, "distance"), self._point(b, "distance")
        length = float(norm(q - p))
        along = (q - p) / max(length, 1e-9)
        return Measurement(length, float(np.sqrt(max(float(matmul(along, first + second, along)), 0.0))))

    def save(self, folder: str | Path) -> None:
        """Write the files of `trihedron building`, model.ifc where ifcopenshell is installed.

        Args:
            folder: it is made where there is none.

        Raises:
            DataError: a file cannot be written.
        """
        from trihedron.plugins.building.files import write_building
        from trihedron.plugins.building.ifc import IFC, has_ifc

        out = Path(folder).expanduser()
        with _writing(out, "give another folder"):
            out.mkdir(parents=True, exist_ok=True)
            write_building(out, self.plan)
        if has_ifc():
            self.to_ifc(out / IFC)

    def to_json(self, path: str | Path) -> Path:
        """Write all elements as building.json has them.

        Args:
            path: the file; it is overwritten.

        Returns:
            The path.

        Raises:
            DataError: the file cannot be written.
        """
        from trihedron.plugins.building.files import write_json

        return self._write(path, write_json)

    def to_svg(self, path: str | Path, name: str = "") -> Path:
        """Write the floor plan as SVG.

        Args:
            path: the file; it is overwritten.
            name: what it is a plan of, for its title.

        Returns:
            The path.

        Raises:
            DataError: the file cannot be written.
        """
        from trihedron.plugins.building.svg import write_svg

        return self._write(path, partial(write_svg, name=name))

    def to_pdf(self, path: str | Path, name: str = "") -> Path:
        """Write the floor plan as PDF, to scale.

        Args:
            path: the file; it is overwritten.
            name: what it is a plan of, for its title.

        Returns:
            The path.

        Raises:
            DataError: the file cannot be written.
            LibraryError: matplotlib is not installed.
        """
        from trihedron.plugins.building.pdf import write_pdf

        return self._write(path, partial(write_pdf, name=name))

    def to_dxf(self, path: str | Path) -> Path:
        """Write the floor plan as DXF.

        Args:
            path: the file; it is overwritten.

        Returns:
            The path.

        Raises:
            DataError: the file cannot be written.
        """
        from trihedron.plugins.building.dxf import write_dxf

        return self._write(path, write_dxf)

    def to_glb(self, path: str | Path) -> Path:
        """Write the model as binary glTF.

        Args:
            path: the file; it is overwritten.

        Returns:
            The path.

        Raises:
            DataError: the file cannot be written.
        """
        from trihedron.plugins.building.files import write_glb

        return self._write(path, write_glb)

    def to_ifc(self, path: str | Path) -> Path:
        """Write the model as IFC4.

        Args:
            path: the file; it is overwritten.

        Returns:
            The path.

        Raises:
            DataError: the file cannot be written.
            LibraryError: ifcopenshell is not installed.
        """
        from trihedron.plugins.building.ifc import write_ifc

        return self._write(path, write_ifc)

    def _write(self, path: str | Path, write: Callable[[Path, types.Building], None]) -> Path:
        file = Path(path).expanduser()
        with _writing(file, "give a path in a folder that exists"):
            write(file, self.plan)
        return file

    def __repr__(self) -> str:
        return repr(self.plan)

    def _repr_html_(self) -> str | None:
        import trihedron.plugins.building.picture  # noqa: F401, whose picture is that of a plan
        from trihedron.pipeline.core.pictures import html_of

        return html_of(self.plan)

    def _point(self, thing: Any, place: str) -> tuple[F64, F64]:
        """Return a point (3,) in the building's frame and its covariance (3, 3)."""
        if isinstance(thing, Opening):
            along = np.array([*self.walls[thing.wall].along, 0.0])
            return thing.middle, np.outer(along, along) * (thing.width_m.sigma / 2.0) ** 2
        T, covariance = self.plan.T_world_building, np.zeros((3, 3))
        if isinstance(thing, Pose):
            R = matmul(T[:3, :3].T, thing.T_world_camera[:3, :3])
            thing, covariance = thing.T_world_camera, matmul(R, thing.covariance[:3, :3], R.T)
        try:
            given = np.asarray(thing, np.float64)
        except (TypeError, ValueError):
            given = np.empty(0)
        if given.shape not in ((4, 4), (3,)):
            raise UsageError(place, f"is given {type(thing).__name__}, no place", "give a wall, an opening, a pose, a (4, 4) matrix or a point (3,)")
        position = given[:3, 3] if given.ndim == 2 else given
        return np.asarray(matmul(T[:3, :3].T, position - T[:3, 3])), np.asarray(covariance)

    def _wall(self, k: int) -> Wall:
        start, end = self.plan.walls_m[k]
        offset, thickness, _ = (float(value) for value in np.sqrt(np.diag(self.plan.wall_covariance[k])))
        sigma = float(np.hypot(self._end_sigma(k, start), self._end_sigma(k, end)))
        rows = self.plan.unseen[self.plan.unseen[:, 0].astype(int) == k]
        return Wall(
            k, int(self.plan.wall_storeys[k]), start, end, Measurement(float(norm(end - start)), sigma),
            Measurement(float(self.plan.thickness_m[k]), thickness), offset, rows[:, 1:], quad(self.plan, k, 0.0, float(norm(end - start))),
            name_of(self.plan, "wall", k),
        )  # fmt: skip

    def _end_sigma(self, wall: int, end: F64) -> float:
        """Return the standard deviation of an end (2,) of a wall along it: that of the edge which meets it there."""
        best = (np.inf, END_SIGMA_M)
        for _, a, b in self.plan.loops:
            for j in range(a, b):
                before = a + (j - a - 1) % (b - a)
                if wall in (self.plan.corner_walls[j], self.plan.corner_walls[before]):
                    other = before if self.plan.corner_walls[j] == wall else j
                    best = min(best, (float(norm(self.plan.corners_m[j] - end)), self._edge_sigma(other)))
        return best[1]

    def _edge_sigma(self, corner: int) -> float:
        """Return the standard deviation of the offset, in its room, of the edge that begins at a corner."""
        return edge_sigma(self.plan, corner)

    def _room(self, k: int) -> Room:
        outer, *holes = rings_of(self.plan, k)
        edges = [edge for of, a, b in self.plan.loops if of == k for edge in self._edges(int(a), int(b))]
        first, stop = next((int(a), int(b)) for of, a, b in self.plan.loops if of == k)
        area = Measurement(float(self.plan.areas_m2[k]), area_sigma(self.plan, k))
        openings = tuple(int(o) for o in np.nonzero((self.plan.opening_rooms == k).any(axis=1))[0])
        return Room(
            k, int(self.plan.room_storeys[k]), outer, tuple(holes), tuple(edges), area, self._perimeter(first, stop), openings,
            bool(self.plan.closed[k]), name_of(self.plan, "room", k), use_of(self.plan, k), area_interval(self.plan, k),
            seen_share(self.plan, k),
        )  # fmt: skip

    def _edges(self, a: int, b: int) -> list[Edge]:
        """Return the edges of a ring: each ends where its neighbours are, which their offsets move."""
        found = []
        for j in range(a, b):
            after, before = a + (j - a + 1) % (b - a), a + (j - a - 1) % (b - a)
            p, q = self.plan.corners_m[j], self.plan.corners_m[after]
            sines = np.abs(np.sin(_turns(self.plan.corners_m[a:b])))[[j - a, after - a]]
            ends = [END_SIGMA_M if sine < 0.1 else self._edge_sigma(k) / sine for sine, k in zip(sines, (before, after))]
            sigma = np.hypot(ends[0], ends[1])
            wall = int(self.plan.corner_walls[j])
            found.append(Edge(p, q, Measurement(float(norm(q - p)), float(sigma)), wall if wall >= 0 else None))
        return found

    def _perimeter(self, a: int, b: int) -> Measurement:
        """Return the length of a ring: an edge that moves outwards by 1 adds the tangents of half the angles by which the ring turns at its ends."""
        ring = self.plan.corners_m[a:b]
        tangents = np.tan(np.clip(_turns(ring), -3.0, 3.0) / 2.0)
        gain = tangents + np.roll(tangents, -1)
        sigmas = np.array([self._edge_sigma(j) for j in range(a, b)])
        length = float(np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1).sum())
        return Measurement(length, float(np.sqrt(np.sum((gain * sigmas) ** 2))))

    def _opening(self, k: int) -> Opening:
        wall = self.walls[int(self.plan.opening_walls[k])]
        (left, right), (bottom, top) = self.plan.spans_m[k], self.plan.opening_heights_m[k]
        sigma = np.sqrt(np.diag(self.plan.opening_covariance[k]))
        floor = self.plan.storeys[wall.storey, 0]
        depth = wall.thickness_m.value if np.isfinite(wall.thickness_m.value) else 0.0
        flat = wall.start + (left + right) / 2.0 * wall.along - depth / 2.0 * wall.normal
        middle = np.array([*flat, (floor if np.isfinite(floor) else 0.0) + (bottom + top) / 2.0])
        a, b = (int(room) if room >= 0 else None for room in self.plan.opening_rooms[k])
        width = Measurement(float(right - left), float(np.hypot(sigma[0], sigma[1])))
        height = Measurement(float(top - bottom), float(np.hypot(sigma[2], sigma[3])))
        corners = quad(self.plan, wall.number, float(left), float(right))
        return Opening(
            k, OPENING_KINDS[self.plan.opening_kinds[k]], wall.number, middle, width, height, (a, b), corners, name_of(self.plan, "opening", k)
        )


@contextmanager
def _writing(path: Path, cure: str) -> Iterator[None]:
    """Turn errors of writing into a DataError."""
    try:
        yield
    except OSError as error:
        raise DataError(str(error.filename or path), f"cannot be written: {error.strerror}", cure) from error


def _polygon(corners: F64, holes: tuple[F64, ...] = ()) -> shapely.Polygon:
    import shapely

    return shapely.Polygon(corners, holes)


def _turns(ring: F64) -> F64:
    """Return the angle (n,) by which a ring turns at each corner, positive to the left, rad."""
    ahead = np.roll(ring, -1, axis=0) - ring
    before = np.roll(ahead, 1, axis=0)
    return np.asarray(np.arctan2(before[:, 0] * ahead[:, 1] - before[:, 1] * ahead[:, 0], (before * ahead).sum(axis=1)))


def _between(a: Wall, b: Wall) -> Measurement:
    """Return the smallest gap between faces of two walls that face each other; of the faces' offsets where none do, as on one line."""
    if abs(float(matmul(a.along, b.normal))) > np.sin(np.radians(PARALLEL_DEG)):
        angle = float(np.degrees(np.arcsin(min(abs(float(matmul(a.along, b.normal))), 1.0))))
        raise UsageError(
            "distance", f"walls {a.number} and {b.number} are not parallel but at {angle:.0f}°", "take parallel walls, or a wall and a point"
        )
    middle = (b.start + b.end) / 2.0 - a.start
    gaps = []
    for sign, depth, sigma in _faces(a):
        for other, deep, second in _faces(b):
            facing = sign * other * float(matmul(a.normal, b.normal)) < 0.0
            gap = sign * float(matmul(middle + deep * -b.normal, a.normal) + depth)
            if facing and gap > 0.0:
                gaps.append((gap, float(np.hypot(sigma, second))))
    return Measurement(*min(gaps)) if gaps else Measurement(abs(float(matmul(middle, a.normal))), float(np.hypot(a.offset_sigma_m, b.offset_sigma_m)))


def _faces(wall: Wall) -> list[tuple[float, float, float]]:
    """Return (direction along the wall's normal, depth behind the face, standard deviation) of its faces."""
    faces = [(1.0, 0.0, wall.offset_sigma_m)]
    if np.isfinite(wall.thickness_m.value):
        faces.append((-1.0, wall.thickness_m.value, float(np.hypot(wall.offset_sigma_m, wall.thickness_m.sigma))))
    return faces
