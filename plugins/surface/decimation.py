"""Planar parts of a mesh with as few vertices as their borders need, by half-edge collapse."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.surface.decimation_kernels import collapse_all

STEP = 0x9E3779B1  # visits vertices in an order without order, so that no vertex gathers all the others' triangles,
NEAR = 1024  # but so many that follow each other before the next: they are near each other, in memory too


def decimate(vertices: F64, triangles: I32, labels: I32, planes: F64, border: Bool, free: Bool, beside: I32) -> I32:
    """The rows (t,) that stay, in triangles (t, 3) that are changed in place. Vertices of one plane's triangles alone go; those on a border (v,) go
    when they are `free` (v,), along it: `beside` (v, 2) are the neighbours there."""
    number = np.arange(len(vertices), dtype=np.uint64)
    order = np.lexsort((number * np.uint64(STEP) % np.uint64(1 << 32), number // np.uint64(NEAR))).astype(np.int32)
    alive = np.ones(len(triangles), np.bool_)
    collapse_all(vertices, triangles, labels, planes[:, :3].copy(), border, free, beside.copy(), order, alive)
    return np.flatnonzero(alive).astype(np.int32)
