"""Holes that are too small to have been seen: left where parts of a mesh that were cut into triangles one by one meet."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.types import F64, I32
from trihedron.plugins.numerics.surfaces.half_edges import opposite_half_edges

WIDEST_M = 0.01  # along each axis
LONGEST = 8  # edges


def without_pinholes(points: F64, triangles: I32, labels: I32) -> tuple[I32, I32]:
    """Triangles (t, 3) and their labels (t,), more of them where rings of open edges are closed by fans, labelled as what is beside them."""
    begin, end = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    rim = np.flatnonzero(opposite_half_edges(triangles) < 0)
    onward = dict(zip(begin[rim].tolist(), rim.tolist()))
    fans, owners, done = [triangles], [labels], set()
    for first in rim.tolist():
        ring = _ring(first, onward, end) if first not in done else []
        done.update(ring)
        corners = begin[ring]
        if len(ring) >= 3 and np.ptp(points[corners], axis=0).max() < WIDEST_M:
            fans.append(np.array([(corners[0], corners[i + 1], corners[i]) for i in range(1, len(ring) - 1)], np.int32))
            owners.append(np.full(len(ring) - 2, labels[first // 3], labels.dtype))
    return np.concatenate(fans).astype(np.int32), np.concatenate(owners)


def _ring(first: int, onward: dict[int, int], end: I32) -> list[int]:
    """The open half-edges round a hole, from the first on; none when they do not come back within LONGEST steps."""
    ring = [first]
    while len(ring) <= LONGEST:
        step = onward.get(int(end[ring[-1]]))
        if step == first:
            return ring
        if step is None or step in ring:
            break
        ring.append(step)
    return []
