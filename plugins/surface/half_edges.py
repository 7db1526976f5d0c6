"""Adjacency in a triangle mesh. Half-edge 3 t + k runs from corner k of triangle t to the next one."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.surface.half_edges_kernels import fans_kernel, pair_half_edges, sum_at_vertices, triangle_components, triangle_normals


def opposite_half_edges(triangles: I32) -> I32:
    """(3 t,) the half-edge that runs the other way along the same edge; OPEN where there is none, or the edge has more than two triangles."""
    return pair_half_edges(triangles, int(triangles.max()) + 1 if len(triangles) else 0)


def non_manifold_half_edges(triangles: I32, opposite: I32) -> I32:
    """The half-edges (n,) along edges with more than two triangles, or with two that run along it the same way."""
    alone = np.flatnonzero(opposite < 0)
    ends = np.sort(np.stack([triangles.ravel()[alone], triangles[:, [1, 2, 0]].ravel()[alone]], axis=1), axis=1)
    _, edge, times = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(alone[times[edge.ravel()] > 1], np.int32)


def split_fans(vertices: F64, triangles: I32) -> tuple[F64, I32]:
    """The mesh with a vertex of its own for each fan of triangles: none is shared by sheets that touch in a point alone."""
    fans = fans_kernel(opposite_half_edges(triangles))
    first = fans == np.arange(len(fans))
    number = np.cumsum(first, dtype=np.int32) - np.int32(1)
    return vertices[triangles.ravel()[first]], number[fans].reshape(-1, 3)


def remove_small_components(vertices: F64, triangles: I32, least_m2: float) -> I32:
    """The triangles (n, 3) of those connected sets that have at least that area."""
    parts, count = triangle_components(opposite_half_edges(triangles), np.zeros(len(triangles), np.int32))
    return np.asarray(triangles[np.bincount(parts, triangle_areas(vertices, triangles), count)[parts] >= least_m2])


def remove_unused_vertices(vertices: F64, triangles: I32) -> tuple[F64, I32, I32]:
    """The mesh without the vertices that no triangle uses, and the new numbers of the old vertices (v,)."""
    used = np.zeros(len(vertices), np.bool_)
    used[triangles] = True
    renamed = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return vertices[used], renamed[triangles], renamed


def triangle_areas(vertices: F64, triangles: I32) -> F64:
    """(t,) areas in m²."""
    return np.asarray(0.5 * np.sqrt((triangle_normals(vertices, triangles) ** 2).sum(axis=1)), np.float64)


def vertex_normals(vertices: F64, triangles: I32) -> F64:
    """(v, 3) unit normals, the mean of those of the triangles (t, 3) about a vertex weighed by their areas; zero where there is none."""
    total = np.zeros_like(vertices)
    sum_at_vertices(triangle_normals(vertices, triangles), triangles, total)
    return np.asarray(total / np.maximum(np.sqrt((total**2).sum(axis=1)), 1e-12)[:, None])
