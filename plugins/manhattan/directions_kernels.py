"""Numba kernels of `directions.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import copy_matrix
from trihedron.pipeline.core.types import F32, F64

NORMALS_PER_SAMPLE = 20.0  # neighbouring normals share pixels and the sensor's errors: so many count as one
ROWS_APART = 4  # of those in which valid normals are counted


@kernel
def gather_directions_kernel(normals: F32, ends_m: F32, ends_px: F32, samples: int, per_px: float) -> tuple[F64, F64, int]:
    """Gather the fields of `Directions`."""
    surface = subsample_normals(normals, samples)
    count = len(surface)
    vectors, weights = np.empty((count + len(ends_m), 3)), np.ones(count + len(ends_m))
    copy_matrix(surface, vectors)
    n = count
    for i in range(len(ends_m)):
        square, pixels = 0.0, 0.0
        for k in range(3):
            vectors[n, k] = float(ends_m[i, 1, k]) - ends_m[i, 0, k]
            square += vectors[n, k] ** 2
        for k in range(2):
            pixels += (float(ends_px[i, 1, k]) - ends_px[i, 0, k]) ** 2
        if 1e-12 < square < np.inf and np.isfinite(pixels):
            for k in range(3):
                vectors[n, k] /= np.sqrt(square)
            weights[n] = per_px * np.sqrt(pixels)
            n += 1
    return vectors[:n], weights[:n], count


@kernel
def subsample_normals(normals: F32, most: int) -> F64:
    """At most `most` of the finite normals of a grid (h, w, 3), on a regular sub-grid: (n, 3)."""
    h, w = normals.shape[:2]
    valid = 0
    for r in range(0, h, ROWS_APART):
        for c in range(w):
            valid += min(ROWS_APART, h - r) * np.isfinite(normals[r, c, 2])
    step = max(int(np.ceil(np.sqrt(valid / most))), 1)
    out = np.empty((((h + step - 1) // step) * ((w + step - 1) // step), 3))
    n = 0
    for r in range(step // 2, h, step):
        for c in range(step // 2, w, step):
            if np.isfinite(normals[r, c, 0] + normals[r, c, 1] + normals[r, c, 2]) and n < most:
                for k in range(3):
                    out[n, k] = normals[r, c, k]
                n += 1
    return out[:n]
