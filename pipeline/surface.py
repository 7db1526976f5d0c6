"""The type of the topic `surface`: a triangle mesh with plane instances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np

from trihedron.pipeline.arrays import F32, F64, I32, U8, Shape, Value

PLANE_KINDS = ("plane", "floor", "ceiling", "wall", "horizontal", "vertical")  # a plane is none of the others when it slants, or up is not known


@dataclass(frozen=True)
class Surface(Value):
    """A triangle mesh in the world frame, anticlockwise seen from where it was seen, and the plane instances in it.

    `instances` is the row of the plane a triangle lies in, -1 for none. Of plane i: `plane_ids` is its id in the map (beyond the map's if it is not
    there), `coefficients` n·x + d = 0 with n towards the camera, `kinds` a row of PLANE_KINDS, `areas_m2` that of its triangles, `plane_colors` its
    mean. Row k of `loops` is (plane, begin, end): `loop_vertices[begin:end]` go round it, anticlockwise about n; round a hole the other way.
    `atlas` (RGB) pictures the planes: `texels` are the (x, y) of a triangle's corners in it, pixel centres at integers; NaN without a picture. `up`
    points up in the world, along an axis of the Manhattan frame; NaN when nothing says so."""

    version: ClassVar[int] = 2

    vertices_m: Annotated[F32, Shape("v", 3)]
    colors: Annotated[U8, Shape("v", 3)]
    triangles: Annotated[I32, Shape("t", 3)]
    instances: Annotated[I32, Shape("t")]
    plane_ids: Annotated[I32, Shape("p")]
    coefficients: Annotated[F64, Shape("p", 4)]
    kinds: Annotated[U8, Shape("p")]
    areas_m2: Annotated[F32, Shape("p")]
    plane_colors: Annotated[U8, Shape("p", 3)]
    loops: Annotated[I32, Shape("l", 3)]
    loop_vertices: Annotated[I32, Shape("k")]
    atlas: Annotated[U8, Shape("h", "w", 3)]
    texels: Annotated[F32, Shape("t", 3, 2)]
    up: Annotated[F64, Shape(3)]

    @staticmethod
    def empty(index: int, stamp_ns: int) -> Surface:
        """A mesh without triangles and planes."""
        none, no_number, no_color = np.empty((0, 3), np.float32), np.empty(0, np.int32), np.empty((0, 3), np.uint8)
        atlas, texels = np.empty((0, 0, 3), np.uint8), np.empty((0, 3, 2), np.float32)
        return Surface(
            index, stamp_ns, none, no_color, np.empty((0, 3), np.int32), no_number, no_number.copy(), np.empty((0, 4)), np.empty(0, np.uint8),
            np.empty(0, np.float32), no_color.copy(), np.empty((0, 3), np.int32), no_number.copy(), atlas, texels, np.full(3, np.nan),
        )  # fmt: skip
