"""Kernels of `feature_pairs.py`: pixels predicted by a motion, and pairs of rows."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32


@kernel
def pairs_of_matches(found: I32) -> I32:
    """Convert matches (n,), the current row of each previous feature, -1 = none, to pairs (k, 2)."""
    out, k = np.empty((len(found), 2), np.int32), 0
    for i in range(len(found)):
        if found[i] >= 0:
            out[k, 0], out[k, 1] = i, found[i]
            k += 1
    return out[:k]


@kernel
def predict_pixels_kernel(pixels: F32, points_m: F32, intrinsics: tuple[float, float, float, float], R: F64, t: F64) -> F64:
    """`predict_pixels` of n pixels."""
    out = np.empty((len(pixels), 2))
    for i in range(len(pixels)):
        out[i, 0], out[i, 1] = predict_pixel(pixels[i, 0], pixels[i, 1], points_m[i, 0], points_m[i, 1], points_m[i, 2], intrinsics, R, t)
    return out


@kernel
def predict_pixel(u: float, v: float, x: float, y: float, z: float, camera: tuple[float, float, float, float], R: F64, t: F64) -> tuple[float, float]:
    """`predict_pixels` of the pixel (u, v) with the point (x, y, z)."""
    fx, fy, cx, cy = camera
    near = 1.0
    x, y, z = float(x), float(y), float(z)
    if not np.isfinite(x + y + z):
        x, y, z, near = (u - cx) / fx, (v - cy) / fy, 1.0, 0.0
    depth = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + near * t[2]
    if not depth > 1e-6:
        return np.nan, np.nan
    column = fx * (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + near * t[0]) / depth + cx
    row = fy * (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + near * t[1]) / depth + cy
    return column, row
