"""Kernel of `optical_flow.py`: the nearest key point of each tracked pixel."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32


@kernel
def nearest_pixels(pixels: F32, candidates: F32) -> tuple[I32, F64]:
    """Rows (n,) of the nearest of `candidates` (m, 2), m > 0, to each of the pixels (n, 2), the first of equals, and their distances (n,), px."""
    rows, distances = np.zeros(len(pixels), np.int32), np.empty(len(pixels))
    for i in range(len(pixels)):
        best = np.inf
        for j in range(len(candidates)):
            x, y = pixels[i, 0] - candidates[j, 0], pixels[i, 1] - candidates[j, 1]
            if x * x + y * y < best:
                best, rows[i] = x * x + y * y, j
        distances[i] = np.sqrt(best)
    return rows, distances
