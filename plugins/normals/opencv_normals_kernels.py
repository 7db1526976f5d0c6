"""Kernels of `opencv_normals.py`: points smoothed over patches that cross no depth edge, and the selection of the normals computed from them."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8


@kernel
def smooth_cells(rho: F32, count: U8, full: int, jump: float, jump_m: float) -> U8:
    """(h, w) 1 where a cell's inverse depth rho is that of its centre, because all its `full` readings are there, and no neighbour in its row or
    column differs from it by more than `jump` z + `jump_m`."""
    h, w = rho.shape
    out = (count == full).astype(np.uint8)
    for r in range(h):
        for c in range(w):
            if rho[r, c] <= 0.0:
                continue
            z = 1.0 / rho[r, c]
            for s, d in ((r, c + 1), (r + 1, c)):
                if s < h and d < w and rho[s, d] > 0.0:
                    other = 1.0 / rho[s, d]
                    if abs(z - other) > jump * min(z, other) + jump_m:
                        out[r, c], out[s, d] = 0, 0
    return out


@kernel
def smooth_points(rho: F32, clear: F32, radii: I32, rays_x: F64, rays_y: F64) -> F64:
    """(h, w, 4) points of the cells, inverse depth averaged over a square around each; NaN where there is none, the last number is 0.

    `radii[i]` is the square's half-width in cells at a depth of i decimetres, less where `clear` (as from `clearance`) or the image's border is
    nearer. Inverse depth is linear in the image on a plane, so the mean over a square is that of its centre whatever the plane's slope."""
    h, w = rho.shape
    total = np.zeros((h + 1, w + 1))
    for r in range(h):
        row = 0.0
        for c in range(w):
            row += rho[r, c]
            total[r + 1, c + 1] = total[r, c + 1] + row
    out = np.zeros((h, w, 4))
    for r in range(h):
        for c in range(w):
            if rho[r, c] <= 0.0:
                out[r, c, 0] = out[r, c, 1] = out[r, c, 2] = np.nan
                continue
            p = float(rho[r, c])
            k = min(radii[min(int(10.0 / p), len(radii) - 1)], int(clear[r, c]) - 1, r, c, h - 1 - r, w - 1 - c)
            if k > 0:
                p = total[r + k + 1, c + k + 1] - total[r - k, c + k + 1] - total[r + k + 1, c - k] + total[r - k, c - k]
                p /= (2 * k + 1) * (2 * k + 1)
            out[r, c, 0], out[r, c, 1], out[r, c, 2] = rays_x[c] / p, rays_y[r] / p, 1.0 / p
    return out


@kernel
def select_normals(normals: F64, rho: F32, clear: F32, radii: I32, reach: int, border: int, rays_x: F64, rays_y: F64) -> F32:
    """Select the valid normals (h, w, 3) of OpenCV's (h, w, 4), unit and towards the camera. NaN where the length is far from 1, within `border`
    cells of the image's border or `reach` of a cell that is not smooth, or where either left less than half of the square of `smooth_points`."""
    h, w = clear.shape
    out = np.full((h, w, 3), np.nan, np.float32)
    for r in range(border, h - border):
        for c in range(border, w - border):
            if rho[r, c] <= 0.0:
                continue
            least = radii[min(int(10.0 / rho[r, c]), len(radii) - 1)] // 2
            if clear[r, c] <= reach + least or min(r, c, h - 1 - r, w - 1 - c) < least:
                continue
            x, y, z = normals[r, c, 0], normals[r, c, 1], normals[r, c, 2]
            length = np.sqrt(x * x + y * y + z * z)
            if not 0.5 < length < 2.0:
                continue
            if x * rays_x[c] + y * rays_y[r] + z > 0.0:
                length = -length
            out[r, c, 0], out[r, c, 1], out[r, c, 2] = x / length, y / length, z / length
    return out
