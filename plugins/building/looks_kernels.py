"""Numba kernels of `looks.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32


@kernel
def looks_kernel(depth: F32, camera: F64, T: F64, line: F64, normal: F64, heights: F64, nearest_m: float, margin: F64, on: I32, beyond: I32) -> None:
    """Add to `on` and `beyond` (k, levels) one where a view reads a vertical plane at a column and a height, or what is behind it.

    `line` (k, 2) are the columns' places on the plan, `normal` (2,) the plane's, towards the side it is seen from, `heights` (levels,) the levels';
    T is `T_camera_building`. Views nearer to the plane than `nearest_m` and columns not in a view add nothing. A reading z m away is on the plane
    within `margin[0] + margin[1] z²`, at most `margin[2]`, of it along the normal, and behind it from `margin[3]` more."""
    h, w = depth.shape
    eye_x = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    eye_y = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    away = (eye_x - line[0, 0]) * normal[0] + (eye_y - line[0, 1]) * normal[1]
    if away < nearest_m:
        return
    for k in range(line.shape[0]):
        x = T[0, 0] * line[k, 0] + T[0, 1] * line[k, 1] + T[0, 3]
        y = T[1, 0] * line[k, 0] + T[1, 1] * line[k, 1] + T[1, 3]
        z = T[2, 0] * line[k, 0] + T[2, 1] * line[k, 1] + T[2, 3]
        for level in range(heights.shape[0]):
            ahead = z + T[2, 2] * heights[level]
            if ahead < 0.3:
                continue
            c = int(np.floor((x + T[0, 2] * heights[level]) / ahead * camera[0] + camera[2] + 0.5))
            r = int(np.floor((y + T[1, 2] * heights[level]) / ahead * camera[1] + camera[3] + 0.5))
            if r < 0 or r >= h or c < 0 or c >= w:
                continue
            read = float(depth[r, c])
            if not read > 0.0:
                continue
            behind, near = away * (read / ahead - 1.0), min(margin[0] + margin[1] * read * read, margin[2])
            if behind > near + margin[3]:
                beyond[k, level] += 1
            elif abs(behind) < near:
                on[k, level] += 1
