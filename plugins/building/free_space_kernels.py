"""Numba kernels of `free_space.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64

U32 = NDArray[np.uint32]
LEVELS = 32  # heights that a cell of the grid distinguishes


@kernel
def carve_kernel(
    depth: F32, camera: F64, T: F64, origin: F64, side_m: float, floor_m: float, level_m: float, step: int, margin: F64, once: U32, twice: U32
) -> None:
    """Mark in the cells (h, w) of a plan the levels that the rays of a depth image pass: `once` and, from the second ray on, `twice`.

    A ray ends `margin[0] + margin[1] z²` before its reading; T is `T_building_camera`, `origin` the lower corner of cell (0, 0)."""
    h, w = once.shape
    x0, y0, z0 = (T[0, 3] - origin[0]) / side_m, (T[1, 3] - origin[1]) / side_m, (T[2, 3] - floor_m) / level_m
    for r in range(step // 2, depth.shape[0], step):
        for c in range(step // 2, depth.shape[1], step):
            z = float(depth[r, c])
            if not z > 0.0:
                continue
            x, y = (c - camera[2]) / camera[0], (r - camera[3]) / camera[1]
            dx = T[0, 0] * x + T[0, 1] * y + T[0, 2]
            dy = T[1, 0] * x + T[1, 1] * y + T[1, 2]
            dz = T[2, 0] * x + T[2, 1] * y + T[2, 2]
            length = np.sqrt(1.0 + x * x + y * y)
            free = z - (margin[0] + margin[1] * z * z) / length
            flat = np.sqrt(dx * dx + dy * dy)
            if free <= 0.0:
                continue
            steps = int(np.ceil(free * max(flat / side_m, abs(dz) / level_m))) + 1
            last, pace = -1, free / steps
            dx, dy, dz = dx * pace / side_m, dy * pace / side_m, dz * pace / level_m
            for k in range(steps):
                column, row = int(np.floor(x0 + (k + 0.5) * dx)), int(np.floor(y0 + (k + 0.5) * dy))
                level = int(np.floor(z0 + (k + 0.5) * dz))
                if level < 0 or level >= LEVELS or row < 0 or row >= h or column < 0 or column >= w:
                    continue
                place = (row * w + column) * LEVELS + level
                if place == last:
                    continue
                last = place
                bit = np.uint32(1) << np.uint32(level)
                twice[row, column] |= once[row, column] & bit
                once[row, column] |= bit
