"""Adjacency in a triangle mesh. Half-edge 3 t + k runs from corner k of triangle t to the next one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.linalg import det
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.surface.common_meshes_kernels import collapse_all, connected, fans_kernel, gather, kept, loops, paired, triangle_normals


def opposite_half_edges(triangles: I32) -> I32:
    """(3 t,) the half-edge that runs the other way along the same edge; OPEN where there is none, or the edge has more than two triangles."""
    return paired(triangles, int(triangles.max()) + 1 if len(triangles) else 0)


def crowded(triangles: I32, opposite: I32) -> I32:
    """The half-edges (n,) along edges with more than two triangles, or with two that run along it the same way."""
    alone = np.flatnonzero(opposite < 0)
    ends = np.sort(np.stack([triangles.ravel()[alone], triangles[:, [1, 2, 0]].ravel()[alone]], axis=1), axis=1)
    _, edge, times = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    return np.asarray(alone[times[edge.ravel()] > 1], np.int32)


def with_single_fans(vertices: F64, triangles: I32) -> tuple[F64, I32]:
    """The mesh with a vertex of its own for each fan of triangles: none is shared by sheets that touch in a point alone."""
    fans = fans_kernel(opposite_half_edges(triangles))
    first = fans == np.arange(len(fans))
    number = np.cumsum(first, dtype=np.int32) - np.int32(1)
    return vertices[triangles.ravel()[first]], number[fans].reshape(-1, 3)


def triangle_areas(vertices: F64, triangles: I32) -> F64:
    """(t,) areas in m²."""
    return np.asarray(0.5 * np.sqrt((triangle_normals(vertices, triangles) ** 2).sum(axis=1)), np.float64)


def vertex_normals(vertices: F64, triangles: I32) -> F64:
    """(v, 3) unit normals, the mean of those of the triangles (t, 3) about a vertex weighed by their areas; zero where there is none."""
    total = np.zeros_like(vertices)
    gather(triangle_normals(vertices, triangles), triangles, total)
    return np.asarray(total / np.maximum(np.sqrt((total**2).sum(axis=1)), 1e-12)[:, None])


def without_crumbs(vertices: F64, triangles: I32, least_m2: float) -> I32:
    """The triangles (n, 3) of those connected sets that have at least that area."""
    parts, count = connected(opposite_half_edges(triangles), np.zeros(len(triangles), np.int32))
    return np.asarray(triangles[np.bincount(parts, triangle_areas(vertices, triangles), count)[parts] >= least_m2])


def compacted(vertices: F64, triangles: I32) -> tuple[F64, I32, I32]:
    """The mesh without the vertices that no triangle uses, and the new numbers of the old vertices (v,)."""
    used = np.zeros(len(vertices), np.bool_)
    used[triangles] = True
    renamed = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return vertices[used], renamed[triangles], renamed


# The borders between the parts of a mesh: which of their vertices are kept when they are simplified, and the loops they make.
#
# A border is a chain of edges between two junctions. It is simplified once, for the parts on both of its sides: neighbours keep the same vertices, so
# no vertex of one lies within an edge of the other.

REST = -1  # the part of triangles that lie in no plane


def border_half_edges(parts: I32, opposite: I32) -> I32:
    """The half-edges (n,) of planar triangles (t,) beyond which there is another part, or nothing."""
    own = np.repeat(parts, 3)
    beyond = np.where(opposite >= 0, parts[np.maximum(opposite, 0) // 3], REST - 1)
    return np.flatnonzero((own != REST) & (own != beyond)).astype(np.int32)


def fixed_vertices(count: int, triangles: I32, parts: I32, opposite: I32) -> Bool:
    """(v,) vertices that stay whatever happens: those of triangles in no plane, and those of edges with more than two triangles."""
    fixed = np.zeros(count, np.bool_)
    fixed[triangles[parts == REST]] = True
    shared = crowded(triangles, opposite)
    fixed[triangles.ravel()[shared]] = fixed[triangles[:, [1, 2, 0]].ravel()[shared]] = True
    return fixed


def kept_vertices(vertices: F64, triangles: I32, parts: I32, opposite: I32, border: I32, fixed: Bool, tolerance_m: float) -> tuple[Bool, I32]:
    """(v,) border vertices that are kept: fixed ones, junctions, and those that the chains between need to stay within the tolerance
    (Douglas and Peucker 1973); and (v, 2) the neighbours of the others along their chains."""
    chosen = border[(opposite[border] < 0) | (parts[np.maximum(opposite[border], 0) // 3] == REST) | (border < opposite[border])]
    begin, end = triangles.ravel()[chosen], triangles[:, [1, 2, 0]].ravel()[chosen]
    far = np.where(opposite[chosen] >= 0, parts[np.maximum(opposite[chosen], 0) // 3], REST - 1)
    sides = np.sort(np.stack([parts[chosen // 3], far], axis=1), axis=1).astype(np.int64)
    kinds = sides[:, 0] * (parts.max() + 4) + sides[:, 1]
    return kept(vertices, begin.astype(np.int32), end.astype(np.int32), kinds, fixed, tolerance_m)


# Holes that are too small to have been seen: left where parts of a mesh that were cut into triangles one by one meet.

WIDEST_M = 0.01  # along each axis
LONGEST = 8  # edges


def without_pinholes(points: F64, triangles: I32, labels: I32) -> tuple[I32, I32]:
    """Triangles (t, 3) and their labels (t,), more of them where rings of open edges are closed by fans, labelled as what is beside them."""
    opposite, one_part = opposite_half_edges(triangles), np.zeros(len(triangles), np.int32)
    order, starts = loops(border_half_edges(one_part, opposite), one_part, opposite)
    fans, owners = [triangles], [labels]
    for a, b in pairwise(starts):
        corners = triangles.ravel()[order[a:b]]
        if 3 <= b - a <= LONGEST and np.ptp(points[corners], axis=0).max() < WIDEST_M:
            fans.append(np.array([(corners[0], corners[i + 1], corners[i]) for i in range(1, b - a - 1)], np.int32))
            owners.append(np.full(b - a - 2, labels[order[a] // 3], labels.dtype))
    return np.concatenate(fans).astype(np.int32), np.concatenate(owners)


STEP = 0x9E3779B1  # visits vertices in an order without order, so that no vertex gathers all the others' triangles,
NEAR = 1024  # but so many that follow each other before the next: they are near each other, in memory too


def decimated(vertices: F64, triangles: I32, labels: I32, planes: F64, border: Bool, free: Bool, beside: I32) -> I32:
    """The rows (t,) that stay, in triangles (t, 3) that are changed in place. Vertices of one plane's triangles alone go; those on a border (v,) go
    when they are `free` (v,), along it: `beside` (v, 2) are the neighbours there."""
    number = np.arange(len(vertices), dtype=np.uint64)
    order = np.lexsort((number * np.uint64(STEP) % np.uint64(1 << 32), number // np.uint64(NEAR))).astype(np.int32)
    alive = np.ones(len(triangles), np.bool_)
    collapse_all(vertices, triangles, labels, planes[:, :3].copy(), border, free, beside.copy(), order, alive)
    return np.flatnonzero(alive).astype(np.int32)


# Coordinates within a plane.


def plane_axes(plane: F64) -> F64:
    """(3, 2) orthonormal columns in the plane (4,): with its normal they make a right-handed frame, so what is anticlockwise in them is so about
    n."""
    basis = tangent_basis(plane[:3])
    return basis if det(np.column_stack([basis, plane[:3]])) > 0.0 else np.ascontiguousarray(basis[:, ::-1])
