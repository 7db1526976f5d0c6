"""The exact surface of a synthetic scene as triangles with labels: the truth that meshes are judged by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.datasets.simulation.room import BOX, CYLINDER, UP, Face, Room, Solid
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Bool

SAGITTA_M = 0.0002  # how far the facets of a circle are inside it


@dataclass(frozen=True)
class TrueSurface:
    """(v, 3) vertices in the world of the ground truth, (t, 3) triangles, and for each the face it belongs to and whether that is curved.
    Faces run through solids that stand against them: what no camera can see is part of it too."""

    vertices_m: F64
    triangles: I32
    faces: I32
    curved: Bool


def surface_of(room: Room) -> TrueSurface:
    """The faces of the room, clipped to where it is, then those of each solid, in the order of `room.all_faces`."""
    patches = [_clip_polygon(_rectangle(face), room.planes) for face in room.faces]
    for solid in room.solids:
        patches += _patches(solid)
    vertices, triangles, faces, first = [], [], [], 0
    for number, (points, corners) in enumerate(patches):
        vertices.append(points)
        triangles.append(corners + first)
        faces.append(np.full(len(corners), number))
        first += len(points)
    kinds = np.array([face.curved != BOX for face in (*room.faces, *(face for solid in room.solids for face in solid.faces))])
    owner = np.concatenate(faces).astype(np.int32)
    return TrueSurface(np.concatenate(vertices), np.concatenate(triangles).astype(np.int32), owner, kinds[owner])


def _rectangle(face: Face) -> F64:
    """(4, 3) corners of a flat face, anticlockwise about its normal."""
    width, height = face.u * face.size_m[0], face.v * face.size_m[1]
    return np.asarray(face.origin + np.array([0.0 * width, height, width + height, width]))


def _fan(polygon: F64) -> tuple[F64, I32]:
    """A convex polygon (n, 3) as triangles about its first corner."""
    k = np.arange(1, len(polygon) - 1)
    return polygon, np.stack([0 * k, k, k + 1], axis=1).astype(np.int32)


def _clip_polygon(polygon: F64, planes: F64) -> tuple[F64, I32]:
    """The part of a convex polygon (n, 3) on the positive side of all planes (k, 4) (Sutherland and Hodgman)."""
    for plane in planes:
        height = matmul(polygon, plane[:3]) + plane[3]
        kept = []
        for k in range(len(polygon)):
            other = (k + 1) % len(polygon)
            if height[k] >= -1e-9:
                kept.append(polygon[k])
            if (height[k] > 1e-9 and height[other] < -1e-9) or (height[k] < -1e-9 and height[other] > 1e-9):
                kept.append(polygon[k] + (polygon[other] - polygon[k]) * height[k] / (height[k] - height[other]))
        polygon = np.array(kept)
    return _fan(polygon)


def _patches(solid: Solid) -> list[tuple[F64, I32]]:
    """One patch for each face of a solid."""
    if solid.kind == BOX:
        return [_fan(_rectangle(face)) for face in solid.faces]
    around = 2 * int(np.ceil(0.5 * np.pi / np.sqrt(2.0 * SAGITTA_M / solid.half[0])))
    turn = np.arange(around) * 2.0 * np.pi / around
    circle = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    if solid.kind == CYLINDER:
        radius, half = solid.half[0], solid.half[2]
        low, high = (solid.centre + circle * radius + UP * level for level in (-half, half))
        return [_strips(np.stack([low, high])), _fan(low[::-1]), _fan(high)]
    polar = np.linspace(np.pi, 0.0, around // 2 + 1)
    rings = circle[None] * np.sin(polar)[:, None, None] + UP * np.cos(polar)[:, None, None]
    return [_strips(solid.centre + solid.half[0] * rings)]


def _strips(rings: F64) -> tuple[F64, I32]:
    """Rings (r, n, 3) of points, from below, anticlockwise seen from above, joined by quads cut in two."""
    r, n, _ = rings.shape
    i, k = (a.ravel() for a in np.meshgrid(np.arange(r - 1), np.arange(n), indexing="ij"))
    a, b, c, d = i * n + k, i * n + (k + 1) % n, (i + 1) * n + (k + 1) % n, (i + 1) * n + k
    return rings.reshape(-1, 3), np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
