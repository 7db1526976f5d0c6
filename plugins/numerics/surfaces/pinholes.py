"""Holes that are too small to have been seen: left where parts of a mesh that were cut into triangles one by one meet."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.surfaces.borders import border_half_edges, loops
from trihedron.plugins.numerics.surfaces.half_edges import opposite_half_edges

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
