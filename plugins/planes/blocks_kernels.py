"""Square blocks of a grid's cells, each with the sums from which its plane, or that of any union of blocks, follows in closed form.

With 1 / z = q·r along the ray r = (x, y, 1) and weights w = 1/σ², a block's sums are Σwx², Σwxy, Σwx, Σwy², Σwy, Σw, Σwxρ, Σwyρ, Σwρ, Σwρ² and the
number of depths, at the places named below. Sums add when blocks are joined. The mean squared residual (mse) of a fit is in units of σ_z² of the
sensor's noise model: the same threshold serves at every range, and no unit of length enters.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32
from trihedron.plugins.shared.depth_image_kernels import Grid

WXX, WXY, WX, WYY, WY, W, WXP, WYP, WP, WPP, DEPTHS = range(11)  # places of the sums; P is ρ, the inverse depth
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
            s[WXX] += wx * x
            s[WXY] += wx * y
            s[WX] += wx
            s[WYY] += wy * y
            s[WY] += wy
            s[W] += weight
            s[WXP] += wx * p
            s[WYP] += wy * p
            s[WP] += wp
            s[WPP] += wp * p
            s[DEPTHS] += count[r, c]
    for i in range(rows):
        for j in range(cols):
            if cells[i, j] < share * side * side:
                sums[i, j] = 0.0
    return sums


@kernel
def block_plane(s: F64) -> tuple[float, float, float, float]:
    """Fit a plane to a block's sums (11,): q (three numbers) and the mse, infinite without a plane. Centred first, so that nothing cancels."""
    if s[W] <= 0.0:
        return 0.0, 0.0, 0.0, np.inf
    x, y, p = s[WX] / s[W], s[WY] / s[W], s[WP] / s[W]
    xx, xy, yy = s[WXX] - x * s[WX], s[WXY] - x * s[WY], s[WYY] - y * s[WY]
    xp, yp, pp = s[WXP] - x * s[WP], s[WYP] - y * s[WP], s[WPP] - p * s[WP]
    det = xx * yy - xy * xy
    if not det > 1e-9 * xx * yy:
        return 0.0, 0.0, 0.0, np.inf
    a, b = (yy * xp - xy * yp) / det, (xx * yp - xy * xp) / det
    return a, b, p - a * x - b * y, max(pp - a * xp - b * yp, 0.0) / s[DEPTHS]


@kernel
def block_mse(s: F64, a: float, b: float, c: float) -> float:
    """Mean squared residual, in σ_z², of a block's sums (11,) about the plane q = (a, b, c)."""
    x, y = s[WX] / s[W], s[WY] / s[W]
    mean = s[WP] / s[W] - a * x - b * y - c
    xx, xy, yy = s[WXX] - x * s[WX], s[WXY] - x * s[WY], s[WYY] - y * s[WY]
    xp, yp, pp = s[WXP] - x * s[WP], s[WYP] - y * s[WP], s[WPP] - s[WP] * s[WP] / s[W]
    spread = pp - 2.0 * (a * xp + b * yp) + a * a * xx + 2.0 * a * b * xy + b * b * yy
    return max(spread + s[W] * mean * mean, 0.0) / s[DEPTHS]


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
    """Expand labels (rows, cols) of blocks to labels (h, w) of their cells; 0 without depth."""
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
