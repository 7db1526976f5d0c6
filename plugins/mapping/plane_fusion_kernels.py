"""Numba kernels of `plane_fusion.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32


@kernel
def spread(points: F32, count: int) -> F32:
    """(count, 3) of the finite rows of points (n, 3), each the one farthest from those before it; NaN-padded."""
    out = np.full((count, 3), np.nan, np.float32)
    n = 0
    kept = np.empty((len(points), 3), np.float32)
    for i in range(len(points)):
        if np.isfinite(points[i, 0]):
            kept[n] = points[i]
            n += 1
    distance = np.full(n, np.inf)
    chosen = 0
    for k in range(min(n, count)):
        out[k] = kept[chosen]
        x, y, z = kept[chosen, 0], kept[chosen, 1], kept[chosen, 2]
        farthest = -1.0
        for i in range(n):
            distance[i] = min(distance[i], (kept[i, 0] - x) ** 2 + (kept[i, 1] - y) ** 2 + (kept[i, 2] - z) ** 2)
            if distance[i] > farthest:
                farthest, chosen = distance[i], i
    return out
