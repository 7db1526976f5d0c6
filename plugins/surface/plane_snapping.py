"""Vertices of planar parts moved onto their planes: one plane, the line where two meet, the point where three do."""

from __future__ import annotations

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.surface.plane_snapping_kernels import planes_about, snap_kernel, unfold

ROUNDS = 20  # at most, to unfold what lies the wrong way round after it was moved


def snap_to_planes(vertices: F64, triangles: I32, labels: I32, planes: F64, farthest_m: float) -> F64:
    """Vertices (v, 3), each moved to the nearest point that lies on all planes of the triangles about it, or, if that is too far, on the nearest
    plane."""
    rows, starts = planes_about(len(vertices), triangles, labels)
    points = snap_kernel(vertices, rows, starts, planes, farthest_m)
    planar = labels >= 0
    flat, normals = triangles[planar], planes[labels[planar], :3]
    for _ in range(ROUNDS):
        if not unfold(points, flat, normals, rows, starts):
            break
    return points
