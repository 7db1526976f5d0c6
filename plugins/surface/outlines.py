"""The borders between the parts of a mesh: which of their vertices are kept when they are simplified, and their small holes.

A border is a chain of edges between two junctions. It is simplified once, for the parts on both of its sides: neighbours keep the same vertices, so
no vertex of one lies within an edge of the other.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.surface.half_edges import non_manifold_half_edges, opposite_half_edges
from trihedron.plugins.surface.outlines_kernels import loops, simplify_borders

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
    shared = non_manifold_half_edges(triangles, opposite)
    fixed[triangles.ravel()[shared]] = fixed[triangles[:, [1, 2, 0]].ravel()[shared]] = True
    return fixed


def border_vertices(vertices: F64, triangles: I32, parts: I32, opposite: I32, border: I32, fixed: Bool, tolerance_m: float) -> tuple[Bool, I32]:
    """(v,) border vertices that are kept: fixed ones, junctions, and those that the chains between need to stay within the tolerance
    (Douglas and Peucker 1973); and (v, 2) the neighbours of the others along their chains."""
    chosen = border[(opposite[border] < 0) | (parts[np.maximum(opposite[border], 0) // 3] == REST) | (border < opposite[border])]
    begin, end = triangles.ravel()[chosen], triangles[:, [1, 2, 0]].ravel()[chosen]
    far = np.where(opposite[chosen] >= 0, parts[np.maximum(opposite[chosen], 0) // 3], REST - 1)
    sides = np.sort(np.stack([parts[chosen // 3], far], axis=1), axis=1).astype(np.int64)
    kinds = sides[:, 0] * (parts.max() + 4) + sides[:, 1]
    return simplify_borders(vertices, begin.astype(np.int32), end.astype(np.int32), kinds, fixed, tolerance_m)


# Holes that are too small to have been seen: left where parts of a mesh that were cut into triangles one by one meet.

WIDEST_M = 0.01  # along each axis
LONGEST = 8  # edges


def close_pinholes(points: F64, triangles: I32, labels: I32) -> tuple[I32, I32]:
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
