"""Where features of one image appear in another after a motion."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, Camera


def predict_pixels(pixels: F32, points_m: F32, camera: Camera, R: F64, t: F64) -> F64:
    """Pixels (..., 2) of the previous image moved by (R, t); those without a 3D point (..., 3) as if they were infinitely far."""
    far = camera.back_project(pixels.astype(np.float64), np.ones(pixels.shape[:-1])) @ R.T
    near = points_m.astype(np.float64) @ R.T + t
    return camera.project(np.where(np.isfinite(near).all(axis=-1, keepdims=True), near, far))


def offset_px(predicted: F64, found: F32) -> F64:
    """(n,) mean distance (px) of the ends of predicted segments (n, 2, 2) from the lines found."""
    along = (found[:, 1] - found[:, 0]).astype(np.float64)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    return np.asarray(np.abs(((predicted - found[:, :1]) * normal[:, None]).sum(axis=2)).mean(axis=1))


@numba.njit(cache=True, nogil=True)
def nearest_pixels(pixels: F32, among: F32) -> tuple[I32, F64]:
    """(n,) rows of the nearest of `among` (m, 2), m > 0, to each of the pixels (n, 2), the first of equals, and their distances (n,), px."""
    rows, distances = np.zeros(len(pixels), np.int32), np.empty(len(pixels))
    for i in range(len(pixels)):
        best = np.inf
        for j in range(len(among)):
            x, y = pixels[i, 0] - among[j, 0], pixels[i, 1] - among[j, 1]
            if x * x + y * y < best:
                best, rows[i] = x * x + y * y, j
        distances[i] = np.sqrt(best)
    return rows, distances
