"""The furnished room: what stands where. World frame: origin in a corner of the floor, x along the long wall, z up, metres.

The room itself is convex: its walls are the sides of a footprint polygon. Furniture is boxes, upright cylinders and spheres, each turned about the
vertical only. Every surface is a face with a material and, where it is flat, a frame for its texture.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from trihedron.pipeline.core.linalg import matmul, norm, solve
from trihedron.pipeline.core.types import F64

HEIGHT_M = 2.7
RECTANGLE = ((0.0, 0.0), (5.0, 0.0), (5.0, 4.0), (0.0, 4.0))  # anticlockwise: south, east, north, west wall
SLANTED = ((0.0, -0.5), (5.0, 0.4), (5.7, 4.0), (0.0, 4.0))  # south and east wall turned by 10° and 11°
LAMP_M = (2.5, 2.0, 2.45)
LEAN = np.array([[1.0, 0.25, 0.25], [0.0, 1.0, 0.25], [0.0, 0.0, 1.0]])  # a shear after which all right angles are off by 10° to 14°
BOX, CYLINDER, SPHERE = 0, 1, 2
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Face:
    """A surface: texture coordinates in metres are `(p - origin) · u` and `(p - origin) · v`; size is their extent. `normal` points into the room.

    On a cylinder's side they are arc length and height below the top, on a sphere longitude and latitude times the radius."""

    origin: F64
    u: F64
    v: F64
    normal: F64
    size_m: tuple[float, float]
    material: str
    curved: int = BOX  # CYLINDER or SPHERE for a curved face
    look: int = -1  # faces of one look, material and size show the same texture; -1 = one of its own


@dataclass(frozen=True)
class Solid:
    """A piece of furniture: half extents (box; radius, radius, half height of a cylinder; radius of a sphere) and its turn about the vertical."""

    kind: int
    centre: F64
    half: F64
    yaw: float
    faces: tuple[Face, ...]

    @property
    def R_world_solid(self) -> F64:
        """(3, 3) rotation about the vertical."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class Glass(Enum):
    """Kind of pane: one that reflects, one that is seen through, one that is seen through but swallows the light of the projector."""

    mirror = 0
    inner = 1
    outer = 2


@dataclass(frozen=True)
class Pane:
    """A rectangle from `origin` (3,) along the unit directions `u`, `v` (3,), with the unit normal (3,) towards the side from which a mirror is
    seen; metres, in the frame of the scene."""

    kind: Glass
    origin: F64
    u: F64
    v: F64
    normal: F64
    size_m: tuple[float, float]


def pane_before(face: Face, kind: Glass, off_m: float = 0.005, frame_m: float = 0.04) -> Pane:
    """Put a pane before a flat face, within a frame of it."""
    width, height = face.size_m
    origin = face.origin + off_m * face.normal + frame_m * (face.u + face.v)
    return Pane(kind, origin, face.u, face.v, face.normal, (width - 2.0 * frame_m, height - 2.0 * frame_m))


@dataclass(frozen=True)
class Room:
    """Walls, floor and ceiling as (k, 4) planes `n·x + d = 0` with n into the room, their faces in the same order, and the furniture.

    A face is lit by the nearest lamp in front of it; `detail` multiplies the resolution of the textures; `storeys_m` are heights of floor and
    ceiling, `panes` mirrors and glass before the rest."""

    planes: F64
    faces: tuple[Face, ...]
    solids: tuple[Solid, ...] = field(default_factory=tuple)
    lamps_m: tuple[tuple[float, float, float], ...] = (LAMP_M,)
    detail: float = 1.0
    storeys_m: tuple[tuple[float, float], ...] = ((0.0, HEIGHT_M),)
    panes: tuple[Pane, ...] = ()


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], material: str, front: str = "", front_face: int = 0) -> Solid:
    """An axis-aligned box from its ranges; one face (0..5: -x +x -y +y -z +z) may be of another material."""
    low, high = np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])
    return turned_box((low + high) / 2.0, (high - low) / 2.0, 0.0, material, front, front_face)


def turned_box(centre: F64, half: F64, yaw: float, material: str, front: str = "", front_face: int = 0) -> Solid:
    """A box turned about the vertical by `yaw` (rad)."""
    c, s = np.cos(yaw), np.sin(yaw)
    axes = (np.array([c, s, 0.0]), np.array([-s, c, 0.0]), UP)
    faces = []
    for number in range(6):
        normal = axes[number // 2] * (1.0 if number % 2 else -1.0)
        flat = number // 2 == 2
        right = axes[0] if flat else np.cross(-normal, UP)
        down = np.cross(-normal, right)
        extent = half[0 if flat or number // 2 == 1 else 1], half[1 if flat else 2]
        origin = centre + normal * half[number // 2] - right * extent[0] - down * extent[1]
        kind = front if front and number == front_face else material
        faces.append(Face(origin, right, down, normal, (2.0 * extent[0], 2.0 * extent[1]), kind))
    return Solid(BOX, centre, half, yaw, tuple(faces))


def cylinder(x: float, y: float, z: tuple[float, float], radius: float, material: str) -> Solid:
    """An upright cylinder; faces: side, bottom, top."""
    centre = np.array([x, y, (z[0] + z[1]) / 2.0])
    height = z[1] - z[0]
    side = Face(np.array([x, y, z[1]]), UP, UP, UP, (2.0 * np.pi * radius, height), material, CYLINDER)
    corner = np.array([x - radius, y + radius, 0.0])
    caps = [
        Face(corner + UP * level, np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]), UP * sign, (2 * radius, 2 * radius), material)
        for level, sign in ((z[0], -1.0), (z[1], 1.0))
    ]
    return Solid(CYLINDER, centre, np.array([radius, radius, height / 2.0]), 0.0, (side, *caps))


def sphere(x: float, y: float, z: float, radius: float, material: str) -> Solid:
    """A sphere; its one face is laid out by longitude and latitude."""
    centre = np.array([x, y, z])
    face = Face(centre, UP, UP, UP, (2.0 * np.pi * radius, np.pi * radius), material, SPHERE)
    return Solid(SPHERE, centre, np.full(3, radius), 0.0, (face,))


@dataclass(frozen=True)
class Wall:
    """A side of the footprint, seen from inside: `start` at the floor, `along` to the left, `normal` into the room."""

    start: F64
    along: F64
    normal: F64
    length_m: float

    def mount_box(
        self, at: float, z: tuple[float, float], width: float, thickness: float, material: str, front: str = "", off_m: float = 0.0
    ) -> Solid:
        """A box on the wall, or `off_m` from it, its middle `at` metres from its start; `front` is the material of the face towards the room."""
        centre = self.start + self.along * at + self.normal * (off_m + thickness / 2.0) + UP * ((z[0] + z[1]) / 2.0)
        half = np.array([width / 2.0, thickness / 2.0, (z[1] - z[0]) / 2.0])
        return turned_box(centre, half, float(np.arctan2(self.along[1], self.along[0])), material, front, 3)


def walls_of(footprint: tuple[tuple[float, float], ...]) -> list[Wall]:
    """The sides of an anticlockwise convex polygon."""
    found = []
    for (x0, y0), (x1, y1) in zip(footprint, footprint[1:] + footprint[:1]):
        length = float(np.hypot(x1 - x0, y1 - y0))
        along = np.array([x1 - x0, y1 - y0, 0.0]) / length
        found.append(Wall(np.array([x0, y0, 0.0]), along, np.array([-along[1], along[0], 0.0]), length))
    return found


def furnished_room(slanted: bool = False) -> Room:
    """The room with all its furniture. `slanted` turns two walls, and what is mounted on them, out of the Manhattan frame."""
    footprint = SLANTED if slanted else RECTANGLE
    planes, faces = shell(footprint)
    return Room(planes, faces, (*_furniture(), *_on_the_walls(walls_of(footprint))))


def shell(footprint: tuple[tuple[float, float], ...], height_m: float = HEIGHT_M) -> tuple[F64, tuple[Face, ...]]:
    """(k, 4) planes and the faces of the walls, the floor and the ceiling around an anticlockwise convex footprint."""
    walls = walls_of(footprint)
    corners = np.array(footprint)
    (west, south), (east, north) = corners.min(axis=0), corners.max(axis=0)
    size = (float(east - west), float(north - south))
    faces = [Face(w.start + w.along * w.length_m + UP * height_m, -w.along, -UP, w.normal, (w.length_m, height_m), "wall") for w in walls]
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    faces.append(Face(np.array([west, north, 0.0]), x, -y, UP, size, "floor"))
    faces.append(Face(np.array([west, south, height_m]), x, y, -UP, size, "ceiling"))
    return np.array([[*face.normal, -float(matmul(face.normal, face.origin))] for face in faces]), tuple(faces)


def leaning_room() -> Room:
    """The rectangular room, bare, under the shear LEAN about its middle: no two of its surfaces are at right angles."""
    upright = furnished_room()
    middle = np.array([*np.mean(RECTANGLE, axis=0), HEIGHT_M / 2.0])
    faces = [_lean_face(face, middle) for face in upright.faces]
    return Room(np.array([[*face.normal, -float(matmul(face.normal, face.origin))] for face in faces]), tuple(faces))


def _lean_face(face: Face, middle: F64) -> Face:
    """A flat face under the shear; its texture covers the parallelogram that it becomes."""
    width, height = face.u * face.size_m[0], face.v * face.size_m[1]
    corners = face.origin + np.array([0.0 * width, width, height, width + height])
    corners = middle + matmul(corners - middle, LEAN.T)
    normal, u = solve(LEAN.T, face.normal), matmul(LEAN, face.u)
    normal, u = normal / norm(normal), u / norm(u)
    frame = np.stack([u, np.cross(u, normal)])
    extent = matmul(corners - corners[0], frame.T)
    size = np.ptp(extent, axis=0)
    return Face(corners[0] + matmul(extent.min(axis=0), frame), frame[0], frame[1], normal, (float(size[0]), float(size[1])), face.material)


def all_faces(room: Room) -> list[Face]:
    """The faces by number: the room's own, then those of each solid."""
    return [*room.faces, *(face for solid in room.solids for face in solid.faces)]


def _furniture() -> list[Solid]:
    cabinet = box((0.6, 2.2), (3.55, 4.0), (0.0, 0.9), "wood", "drawers", 2)
    globe = sphere(0.95, 3.75, 1.07, 0.17, "globe")
    vase = cylinder(1.85, 3.75, (0.9, 1.2), 0.07, "marble")
    shelf = [box((x, x + 0.03), (3.7, 4.0), (0.0, 2.0), "wood") for x in (3.3, 4.47)]
    shelf += [box((3.33, 4.47), (3.7, 4.0), (z, z + 0.03), "wood") for z in (0.05, 0.5, 0.95, 1.4, 1.97)]
    books = [box((3.35, 4.1), (3.74, 3.98), (0.53, 0.82), "paper", "books", 2), box((3.7, 4.45), (3.76, 3.98), (0.98, 1.26), "paper", "books", 2)]
    books += [box((3.36, 3.9), (3.75, 3.98), (1.43, 1.7), "paper", "books", 2), box((3.4, 4.2), (3.73, 3.98), (0.08, 0.38), "paper", "books", 2)]
    sofa = [box((4.15, 4.8), (1.2, 2.8), (0.0, 0.42), "fabric"), box((4.75, 5.0), (1.0, 3.0), (0.0, 0.85), "fabric")]
    sofa += [box((4.15, 4.75), (y, y + 0.2), (0.0, 0.6), "fabric") for y in (1.0, 2.8)]
    table = [box((1.4, 2.8), (0.02, 0.72), (0.71, 0.75), "wood")]
    table += [box((x, x + 0.06), (y, y + 0.06), (0.0, 0.71), "wood") for x in (1.44, 2.7) for y in (0.06, 0.62)]
    monitor = [box((1.75, 2.35), (0.2, 0.24), (0.87, 1.22), "plastic", "screen", 3), box((1.95, 2.15), (0.12, 0.32), (0.75, 0.87), "plastic")]
    crate = turned_box(np.array([0.62, 1.0, 0.3]), np.array([0.3, 0.24, 0.3]), np.radians(32.0), "crate")
    column = cylinder(4.6, 0.55, (0.0, HEIGHT_M), 0.17, "marble")
    lamp = box((2.2, 2.8), (1.7, 2.3), (2.6, 2.7), "plastic")
    return [cabinet, globe, vase, *shelf, *books, *sofa, *table, *monitor, crate, column, lamp]


def _on_the_walls(walls: list[Wall]) -> list[Solid]:
    south, east, north, west = walls
    skirting = [wall.mount_box(wall.length_m / 2.0, (0.0, 0.08), wall.length_m, 0.015, "plastic") for wall in walls]
    door = west.mount_box(2.4, (0.0, 2.05), 0.9, 0.04, "wood", "door")
    pictures = [
        north.mount_box(2.9, (1.25, 1.85), 0.8, 0.025, "plastic", "picture"),
        north.mount_box(4.15, (1.4, 2.0), 0.45, 0.025, "plastic", "picture"),
        south.mount_box(3.55, (1.2, 1.9), 0.55, 0.025, "plastic", "picture"),
        south.mount_box(1.0, (1.3, 1.8), 0.7, 0.025, "plastic", "picture"),
        west.mount_box(0.9, (1.2, 1.9), 0.55, 0.025, "plastic", "picture"),
        west.mount_box(3.4, (1.3, 1.7), 0.5, 0.025, "plastic", "picture"),
    ]
    window = east.mount_box(1.9, (1.1, 2.2), 1.5, 0.03, "plastic", "picture")
    sill = east.mount_box(1.9, (1.04, 1.1), 1.7, 0.12, "plastic")
    return [*skirting, door, *pictures, window, sill]
