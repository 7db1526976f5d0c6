"""Meshes as values of the topic `surface`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from trihedron.pipeline.types import F64, I32, U8, Surface
from trihedron.plugins.numerics.surfaces.view_fold import Gathered


def free_surface(state: Gathered, vertices: F64, colors: U8, triangles: I32, up: F64) -> Surface:
    """A surface of triangles (t, 3) that belong to no plane."""
    empty = Surface.empty(state.index, state.stamp_ns)
    t = len(triangles)
    return replace(
        empty,
        vertices_m=vertices.astype(np.float32),
        colors=colors,
        triangles=triangles,
        instances=np.full(t, -1, np.int32),
        texels=np.full((t, 3, 2), np.nan, np.float32),
        up=up,
    )
