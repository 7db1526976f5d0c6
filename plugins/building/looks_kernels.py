"""Numba kernels of `looks.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32

NEAREST_M = 0.3  # before the camera


@kernel
def _may_be_in_view(x: float, z: float, dx: float, dz: float, f: float, middle: float, w: int, low: float, high: float) -> bool:
    """Say if a line from (x + dx · low, z + dz · low) to the same at `high` may have a place before the camera within the width of the image: along a
    line before it the image's column rises or falls all the way."""
    first, last = z + dz * low, z + dz * high
    if first < NEAREST_M and last < NEAREST_M:
        return False
    if first < NEAREST_M or last < NEAREST_M:
        return True
    one, other = (x + dx * low) / first * f + middle + 0.5, (x + dx * high) / last * f + middle + 0.5
    return not (max(one, other) < 0.0 or min(one, other) >= w)


@kernel
def looks_kernel(depth: F32, camera: F64, T: F64, line: F64, normal: F64, heights: F64, margin: F64, on: I32, beyond: I32) -> None:
    """Add to `on` and `beyond` (k, levels) one where a view reads a vertical plane at a column and a height, or what is behind it.

    `line` (k, 2) are the columns' places on the plan, `normal` (2,) the plane's, towards the side it is seen from, `heights` (levels,) the levels';
    T is `T_camera_building`. Columns not in the view add nothing. A reading z m away is on the plane
    within `margin[0] + margin[1] z²`, at most `margin[2]`, of it along the normal, and behind it from `margin[3]` more."""
    h, w = depth.shape
    eye_x = -(T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3])
    eye_y = -(T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3])
    away = (eye_x - line[0, 0]) * normal[0] + (eye_y - line[0, 1]) * normal[1]
    for k in range(line.shape[0]):
        x = T[0, 0] * line[k, 0] + T[0, 1] * line[k, 1] + T[0, 3]
        y = T[1, 0] * line[k, 0] + T[1, 1] * line[k, 1] + T[1, 3]
        z = T[2, 0] * line[k, 0] + T[2, 1] * line[k, 1] + T[2, 3]
        if not _may_be_in_view(x, z, T[0, 2], T[2, 2], camera[0], camera[2], w, heights[0], heights[-1]):
            continue
        for level in range(heights.shape[0]):
            ahead = z + T[2, 2] * heights[level]
            if ahead < NEAREST_M:
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
