"""Square blocks of a grid's cells, each with the sums from which its plane, or that of any union of blocks, follows in closed form.

With 1 / z = q·r along the ray r = (x, y, 1) (see `organised_grid`) and weights w = 1/σ², a block's row of sums is
(Σwx², Σwxy, Σwx, Σwy², Σwy, Σw, Σwxρ, Σwyρ, Σwρ, Σwρ², n), n the number of depths. Sums add when blocks are joined. The mean squared residual (mse)
of a fit is in units of σ_z² of the sensor's noise model: the same threshold serves at every range, and no unit of length enters.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32
from trihedron.plugins.shared.depth_image_kernels import Grid

SUMS = 11


@kernel
def block_sums(grid: Grid, side: int, share: float) -> F64:
    """(rows, cols, 11) sums of blocks of side × side cells; zeros where fewer than `share` of a block's cells have depth."""
    rho, sigma, count, rays_x, rays_y, _ = grid
    h, w = rho.shape
    rows, cols = (h + side - 1) // side, (w + side - 1) // side
    sums, cells = np.zeros((rows, cols, SUMS)), np.zeros((rows, cols), np.int32)
    for r in range(h):
        y = rays_y[r]
        for c in range(w):
            p = float(rho[r, c])
            if p <= 0.0:
                continue
            s = sums[r // side, c // side]
            cells[r // side, c // side] += 1
            x, weight = rays_x[c], np.int32(count[r, c]) / (float(sigma[r, c]) * sigma[r, c])
            wx, wy, wp = weight * x, weight * y, weight * p
            s[0] += wx * x
            s[1] += wx * y
            s[2] += wx
            s[3] += wy * y
            s[4] += wy
            s[5] += weight
            s[6] += wx * p
            s[7] += wy * p
            s[8] += wp
            s[9] += wp * p
            s[10] += count[r, c]
    for i in range(rows):
        for j in range(cols):
            if cells[i, j] < share * side * side:
                sums[i, j] = 0.0
    return sums


@kernel
def block_plane(s: F64) -> tuple[float, float, float, float]:
    """q (three numbers) of the plane through a row of sums, and the mse; infinite without a plane. Centred first, so that nothing cancels."""
    if s[5] <= 0.0:
        return 0.0, 0.0, 0.0, np.inf
    x, y, p = s[2] / s[5], s[4] / s[5], s[8] / s[5]
    xx, xy, yy = s[0] - x * s[2], s[1] - x * s[4], s[3] - y * s[4]
    xp, yp, pp = s[6] - x * s[8], s[7] - y * s[8], s[9] - p * s[8]
    det = xx * yy - xy * xy
    if not det > 1e-9 * xx * yy:
        return 0.0, 0.0, 0.0, np.inf
    a, b = (yy * xp - xy * yp) / det, (xx * yp - xy * xp) / det
    return a, b, p - a * x - b * y, max(pp - a * xp - b * yp, 0.0) / s[10]


@kernel
def block_mse(s: F64, a: float, b: float, c: float) -> float:
    """Mean squared residual, in σ_z², of a row of sums about the plane q = (a, b, c)."""
    x, y = s[2] / s[5], s[4] / s[5]
    mean = s[8] / s[5] - a * x - b * y - c
    xx, xy, yy = s[0] - x * s[2], s[1] - x * s[4], s[3] - y * s[4]
    xp, yp, pp = s[6] - x * s[8], s[7] - y * s[8], s[9] - s[8] * s[8] / s[5]
    spread = pp - 2.0 * (a * xp + b * yp) + a * a * xx + 2.0 * a * b * xy + b * b * yy
    return max(spread + s[5] * mean * mean, 0.0) / s[10]


@kernel
def block_planes(sums: F64) -> tuple[F64, F64]:
    """q (rows, cols, 3) and mse (rows, cols) of each block; the mse is infinite where there is no plane."""
    rows, cols = sums.shape[:2]
    q, mse = np.zeros((rows, cols, 3)), np.empty((rows, cols))
    for i in range(rows):
        for j in range(cols):
            q[i, j, 0], q[i, j, 1], q[i, j, 2], mse[i, j] = block_plane(sums[i, j])
    return q, mse


@kernel
def blocks_to_cells(blocks: I32, side: int, rho: F32) -> I32:
    """Labels (h, w) of the cells that have depth from those (rows, cols) of their blocks."""
    h, w = rho.shape
    out = np.zeros((h, w), np.int32)
    for r in range(h):
        for j in range(blocks.shape[1]):
            label = blocks[r // side, j]
            if label > 0:
                for c in range(j * side, min((j + 1) * side, w)):
                    if rho[r, c] > 0.0:
                        out[r, c] = label
    return out
