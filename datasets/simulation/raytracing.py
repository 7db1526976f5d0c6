"""An exact ray tracer for the synthetic scenes: boxes, cylinders and spheres in a convex room, float64, one thread.

A ray through pixel (x, y) has the camera-frame direction ((x - cx)/fx, (y - cy)/fy, 1), so its parameter t is the depth z itself.
Each solid is tested only in the rectangle its bounding box projects to, and there only where nothing nearer than the box is known: what stands behind
a wall costs little when the walls come first. What runs for every pixel is inlined: passing it a view costs more than what it computes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trihedron.datasets.simulation.room import BOX, CYLINDER, Face, Room, all_faces
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Camera

NEAR_M = 0.05  # nothing nearer is looked for


class Geometry(NamedTuple):
    """The room as arrays: k planes, s solids, f faces; the room's own faces come first, then those of each solid."""

    planes: F64  # (k, 4)
    kinds: I32  # (s,)
    centres: F64  # (s, 3)
    halves: F64  # (s, 3)
    rotations: F64  # (s, 3, 3) R_world_solid
    first_face: I32  # (s,)
    solid_of_face: I32  # (f,), -1 = the room
    faces: F64  # (f, 17): origin, u, v, normal, kind (BOX = flat), radius, its lamp


class CameraView(NamedTuple):
    """A camera in the room, and the room as this camera sees it."""

    fx: float
    fy: float
    cx: float
    cy: float
    position: F64
    R_world_camera: F64
    solids: F64  # (s, 16): half extents, the camera's position in the solid's frame, R_solid_camera by rows, kind
    room: F64  # (k, 3): the inverse depth of plane k along (dx, dy, 1) is the dot product


def geometry_of(room: Room) -> Geometry:
    """Flatten a room into arrays."""
    faces, owner, first = all_faces(room), [-1] * len(room.faces), []
    for number, solid in enumerate(room.solids):
        first.append(len(owner))
        owner += [number] * len(solid.faces)
    radii = [0.0 if number < 0 else room.solids[number].half[0] for number in owner]
    return Geometry(
        np.ascontiguousarray(room.planes),
        np.array([solid.kind for solid in room.solids], dtype=np.int32),
        np.array([solid.centre for solid in room.solids]).reshape(-1, 3),
        np.array([solid.half for solid in room.solids]).reshape(-1, 3),
        np.array([solid.R_world_solid for solid in room.solids]).reshape(-1, 3, 3),
        np.array(first, dtype=np.int32),
        np.array(owner, dtype=np.int32),
        np.array([[*face.origin, *face.u, *face.v, *face.normal, face.curved, radius, *_lamp(face, room)] for face, radius in zip(faces, radii)]),
    )


def _lamp(face: Face, room: Room) -> F64:
    """The nearest lamp in front of a face; of all lamps when none is in front of it."""
    lamps = np.array(room.lamps_m)
    centre = face.origin if face.curved else face.origin + face.u * (face.size_m[0] / 2.0) + face.v * (face.size_m[1] / 2.0)
    behind = matmul(lamps - centre, face.normal) <= 0.0 if not face.curved else np.zeros(len(lamps))
    nearest_first = np.lexsort((np.linalg.norm(lamps - centre, axis=1), behind))
    return np.asarray(lamps[nearest_first[0]], np.float64)


def view_of(geometry: Geometry, camera: Camera, T_world_camera: F64) -> CameraView:
    """A camera at a pose, with what depends on the pose alone worked out."""
    R, position = np.ascontiguousarray(T_world_camera[:3, :3]), T_world_camera[:3, 3].copy()
    R_solid_world = np.swapaxes(geometry.rotations, 1, 2)
    origins = matmul(R_solid_world, (position - geometry.centres)[:, :, None])[:, :, 0]
    turned = matmul(R_solid_world, R).reshape(-1, 9)
    normals = geometry.planes[:, :3]
    distances = matmul(normals, position) + geometry.planes[:, 3]
    solids = np.column_stack([geometry.halves, origins, turned, geometry.kinds])
    return CameraView(camera.fx, camera.fy, camera.cx, camera.cy, position, R, solids, -matmul(normals, R) / distances[:, None])


@njit(cache=True, nogil=True, error_model="numpy")
def trace(geometry: Geometry, view: CameraView, depth: F64, faces: I32) -> None:
    """Fill (h, w) depth in metres and face number of every pixel."""
    h, w = depth.shape
    _trace_room(view.room, view.fx, view.fy, view.cx, view.cy, depth, faces)
    for s in range(len(view.solids)):
        solid = view.solids[s]
        x0, x1, y0, y1 = _rectangle(solid, view.fx, view.fy, view.cx, view.cy, w, h)
        near = _nearest_corner(solid)
        for y in range(y0, y1 + 1):
            dy = (y - view.cy) / view.fy
            for x in range(x0, x1 + 1):
                if depth[y, x] < near:
                    continue
                t, face = hit(solid, (x - view.cx) / view.fx, dy)
                if t < depth[y, x]:
                    depth[y, x] = t
                    faces[y, x] = geometry.first_face[s] + face


@njit(cache=True, nogil=True, error_model="numpy")
def _trace_room(room: F64, fx: float, fy: float, cx: float, cy: float, depth: F64, faces: I32) -> None:
    """The inverse depth of a plane is linear in the pixel, and from inside a convex room the wall seen is the one with the largest."""
    h, w = depth.shape
    for y in range(h):
        for x in range(w):
            best, face = nearest_wall(room, (x - cx) / fx, (y - cy) / fy)
            depth[y, x] = 1.0 / best
            faces[y, x] = face


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def nearest_wall(room: F64, dx: float, dy: float) -> tuple[float, int]:
    """Inverse depth and number of the wall, floor or ceiling along (dx, dy, 1)."""
    best, face = 0.0, 0
    for p in range(len(room)):
        value = room[p, 0] * dx + room[p, 1] * dy + room[p, 2]
        if value > best:
            best, face = value, p
    return best, face


@njit(cache=True, nogil=True, error_model="numpy")
def _rectangle(solid: F64, fx: float, fy: float, cx: float, cy: float, w: int, h: int) -> tuple[int, int, int, int]:
    """Pixels x0..x1, y0..y1 that may see a solid: the projection of its box, cut at NEAR_M; empty (x0 > x1) when it is behind the camera."""
    low_x, high_x, low_y, high_y = 1e9, -1e9, 1e9, -1e9
    for corner in range(8):
        x, y, z = _corner(solid, corner)
        for axis in range(3):  # each edge once, from its lower corner; and the corner itself
            other = corner | (1 << axis)
            x1, y1, z1 = _corner(solid, other)
            for share in _visible_shares(z, z1):
                depth = z + share * (z1 - z)
                if depth >= 0.999 * NEAR_M:
                    u, v = fx * (x + share * (x1 - x)) / depth + cx, fy * (y + share * (y1 - y)) / depth + cy
                    low_x, high_x = min(low_x, u), max(high_x, u)
                    low_y, high_y = min(low_y, v), max(high_y, v)
    if low_x > high_x:
        return 0, -1, 0, -1
    return int(max(0.0, low_x)), int(min(w - 1.0, high_x + 1.0)), int(max(0.0, low_y)), int(min(h - 1.0, high_y + 1.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_corner(solid: F64) -> float:
    """A depth that no point of a solid's box falls short of."""
    near = np.inf
    for corner in range(8):
        near = min(near, _corner(solid, corner)[2])
    return near - 1e-9


@njit(cache=True, nogil=True, error_model="numpy")
def _corner(solid: F64, corner: int) -> tuple[float, float, float]:
    """Corner 0..7 of a solid's box, in the camera frame."""
    a = solid[0] * (2 * (corner & 1) - 1) - solid[3]
    b = solid[1] * ((corner & 2) - 1) - solid[4]
    c = solid[2] * ((corner & 4) // 2 - 1) - solid[5]
    return (
        solid[6] * a + solid[9] * b + solid[12] * c,
        solid[7] * a + solid[10] * b + solid[13] * c,
        solid[8] * a + solid[11] * b + solid[14] * c,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _visible_shares(z0: float, z1: float) -> tuple[float, float]:
    """The part of an edge in front of the camera, as shares of its length; its ends when all of it is, or none."""
    if (z0 < NEAR_M) == (z1 < NEAR_M):
        return 0.0, 1.0
    cut = (NEAR_M - z0) / (z1 - z0)
    return (cut, 1.0) if z0 < NEAR_M else (0.0, cut)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def hit(solid: F64, dx: float, dy: float) -> tuple[float, int]:
    """Depth, and face number within the solid, where the ray (dx, dy, 1) enters it from outside; infinity for a miss."""
    d0 = solid[6] * dx + solid[7] * dy + solid[8]
    d1 = solid[9] * dx + solid[10] * dy + solid[11]
    d2 = solid[12] * dx + solid[13] * dy + solid[14]
    if solid[15] == BOX:
        return _hit_box(solid, d0, d1, d2)
    if solid[15] == CYLINDER:
        return _hit_cylinder(solid, d0, d1, d2)
    return _hit_sphere(solid, d0, d1, d2)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _hit_box(solid: F64, d0: float, d1: float, d2: float) -> tuple[float, int]:
    """Slabs: the last entry before the first exit."""
    near, far, face = -np.inf, np.inf, 0
    for axis in range(3):
        d = d0 if axis == 0 else (d1 if axis == 1 else d2)
        half, origin = solid[axis], solid[3 + axis]
        if abs(d) < 1e-14:
            if abs(origin) > half:
                return np.inf, 0
            continue
        inverse = 1.0 / d
        side = -half if d > 0.0 else half
        enter, leave = (side - origin) * inverse, (-side - origin) * inverse
        if enter > near:
            near, face = enter, 2 * axis + (0 if d > 0.0 else 1)
        far = min(far, leave)
        if near > far:
            return np.inf, 0
    return (near, face) if near > 0.0 else (np.inf, 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _hit_cylinder(solid: F64, d0: float, d1: float, d2: float) -> tuple[float, int]:
    radius, half, x0, y0, z0 = solid[0], solid[2], solid[3], solid[4], solid[5]
    if abs(z0) > half and d2 != 0.0:  # above or below: through the cap, if it faces the camera
        t = ((-half if d2 > 0.0 else half) - z0) / d2
        x, y = x0 + t * d0, y0 + t * d1
        if t > 0.0 and x * x + y * y <= radius * radius:
            return t, 1 if d2 > 0.0 else 2
    a = d0 * d0 + d1 * d1
    b = d0 * x0 + d1 * y0
    root = b * b - a * (x0 * x0 + y0 * y0 - radius * radius)
    if a < 1e-14 or root < 0.0 or b >= 0.0:
        return np.inf, 0
    t = (-b - math.sqrt(root)) / a
    return (t, 0) if abs(z0 + t * d2) <= half else (np.inf, 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _hit_sphere(solid: F64, d0: float, d1: float, d2: float) -> tuple[float, int]:
    x0, y0, z0 = solid[3], solid[4], solid[5]
    a = d0 * d0 + d1 * d1 + d2 * d2
    b = d0 * x0 + d1 * y0 + d2 * z0
    root = b * b - a * (x0 * x0 + y0 * y0 + z0 * z0 - solid[0] * solid[0])
    if root < 0.0 or b >= 0.0:
        return np.inf, 0
    return (-b - math.sqrt(root)) / a, 0


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def nearest(room: F64, solids: F64, first_face: I32, chosen: NDArray[np.int64], count: int, dx: float, dy: float) -> tuple[float, int]:
    """Depth and face of the nearest hit among the room and the first `count` chosen solids (see CameraView)."""
    inverse, face = nearest_wall(room, dx, dy)
    t = 1.0 / inverse
    for i in range(count):
        t1, f1 = hit(solids[chosen[i]], dx, dy)
        if t1 < t:
            t, face = t1, first_face[chosen[i]] + f1
    return t, face
