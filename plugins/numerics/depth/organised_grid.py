"""An organised depth image as a grid of cells: inverse depths, rays and normals, and the smooth surfaces it falls into.

A plane `n·x + d = 0` is, along the ray r = (x/z, y/z, 1) of a cell, linear in inverse depth: `1 / z = q·r` with `q = -n / d`. The ray is exact and
only z is noisy, so least squares in q with `σ = σ_z / z²` is unbiased and has a closed form.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, U8, Bool
from trihedron.plugins.numerics.depth.depth_sampling import sigma_z


class Grid(NamedTuple):
    """Cells of stride × stride pixels: inverse depth (0 = none), the σ of one reading of it and the number of readings, (h, w) each; x/z of the
    columns (w,) and y/z of the rows (h,); unit normals (h, w, 3), NaN = none."""

    rho: F32
    sigma: F32
    count: I32
    rays_x: F64
    rays_y: F64
    normals: F32


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cell_inverse_depths(
    depth: F32, stride: int, edge: float, edge_m: float, noise: tuple[float, float, float, float]
) -> tuple[F32, F32, I32]:
    """Inverse of the mean depth (h, w) of each block of stride × stride pixels, the σ of one reading of it, and the number of readings.

    Where a block has no depth or a step of more than `edge` z + `edge_m` all three are 0."""
    rows, cols = depth.shape
    h, w = (rows + stride - 1) // stride, (cols + stride - 1) // stride
    rho, sigma, count = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32), np.zeros((h, w), np.int32)
    n, total, low, high = np.empty(w, np.int32), np.empty(w), np.empty(w, np.float32), np.empty(w, np.float32)
    for r in range(h):
        n[:], total[:], low[:], high[:] = 0, 0.0, np.inf, 0.0
        for y in range(r * stride, min((r + 1) * stride, rows)):
            c, left = 0, stride
            for x in range(cols):
                if left == 0:
                    c, left = c + 1, stride
                left -= 1
                z = depth[y, x]
                if 0.0 < z < np.inf:
                    n[c] += 1
                    total[c] += z
                    low[c], high[c] = min(low[c], z), max(high[c], z)
        for c in range(w):
            if n[c] > 0 and high[c] - low[c] <= edge * low[c] + edge_m:
                z = total[c] / n[c]
                rho[r, c], sigma[r, c], count[r, c] = 1.0 / z, sigma_z(z, noise) / (z * z), n[c]
    return rho, sigma, count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cell_rays(h: int, w: int, stride: int, intrinsics: tuple[float, float, float, float]) -> tuple[F64, F64]:
    """x/z of each column (w,) and y/z of each row (h,) at the centres of the cells' blocks."""
    fx, fy, cx, cy = intrinsics
    centre = 0.5 * (stride - 1)
    return (np.arange(w) * stride + centre - cx) / fx, (np.arange(h) * stride + centre - cy) / fy


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_cell(grid: Grid, r: int, c: int, A: F64, b: F64) -> None:
    """Adds a cell's weighted depths to the normal equations of q: A (3, 3), of which only the upper triangle is kept, and b (3,)."""
    x, y, p, s = grid.rays_x[c], grid.rays_y[r], grid.rho[r, c], grid.sigma[r, c]
    weight = grid.count[r, c] / (s * s)
    A[0, 0] += weight * x * x
    A[0, 1] += weight * x * y
    A[0, 2] += weight * x
    A[1, 1] += weight * y * y
    A[1, 2] += weight * y
    A[2, 2] += weight
    b[0] += weight * x * p
    b[1] += weight * y * p
    b[2] += weight * p


@numba.njit(cache=True, nogil=True, error_model="numpy")
def coarser(grid: Grid, edge: float, edge_m: float) -> Grid:
    """The grid of 2 × 2 cells: mean inverse depth and mean normal of those that have one, none across a step of more than `edge` z + `edge_m`."""
    rho, sigma, count, rays_x, rays_y, normals = grid
    rows, cols = rho.shape
    h, w = (rows + 1) // 2, (cols + 1) // 2
    rho2, sigma2, count2 = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32), np.zeros((h, w), np.int32)
    normals2, x2, y2 = np.full((h, w, 3), np.nan, np.float32), np.empty(w), np.empty(h)
    for r in range(h):
        y2[r] = 0.5 * (rays_y[2 * r] + rays_y[min(2 * r + 1, rows - 1)])
        for c in range(w):
            x2[c] = 0.5 * (rays_x[2 * c] + rays_x[min(2 * c + 1, cols - 1)])
            n, total, error, low, high, nx, ny, nz = 0, 0.0, 0.0, np.inf, 0.0, 0.0, 0.0, 0.0
            for i in range(2 * r, min(2 * r + 2, rows)):
                for j in range(2 * c, min(2 * c + 2, cols)):
                    p = rho[i, j]
                    if p <= 0.0:
                        continue
                    n += count[i, j]
                    total += count[i, j] * p
                    error += count[i, j] * sigma[i, j]
                    low, high = min(low, p), max(high, p)
                    if not np.isnan(normals[i, j, 0]):
                        nx += normals[i, j, 0]
                        ny += normals[i, j, 1]
                        nz += normals[i, j, 2]
            if n > 0 and 1.0 / low - 1.0 / high <= edge / high + edge_m:
                rho2[r, c], sigma2[r, c], count2[r, c] = total / n, error / n, n
                length = np.sqrt(nx * nx + ny * ny + nz * nz)
                if length > 0.0:
                    normals2[r, c, 0], normals2[r, c, 1], normals2[r, c, 2] = nx / length, ny / length, nz / length
    return Grid(rho2, sigma2, count2, x2, y2, normals2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def smooth_links(grid: Grid, cos_angle: float, gate: float) -> U8:
    """(h, w) bits: 1 = the cell lies on one smooth surface with its left neighbour, 2 = with the upper one.

    Their normals differ by less than the angle and each lies within `gate` σ_z of the other's tangent plane (Trevor et al. 2013)."""
    rho, sigma, rays_x, rays_y, normals = grid.rho, grid.sigma, grid.rays_x, grid.rays_y, grid.normals
    h, w = rho.shape
    links = np.zeros((h, w), np.uint8)
    here, above = np.zeros((w, 5)), np.zeros((w, 5))  # point, offset n·x of the tangent plane, limit of the offsets; the limit is 0 without depth
    for r in range(h):
        here, above = above, here
        for c in range(w):
            here[c, 4] = 0.0
            a, b, d = normals[r, c, 0], normals[r, c, 1], normals[r, c, 2]
            if rho[r, c] <= 0.0 or np.isnan(a):
                continue
            z = 1.0 / rho[r, c]
            x, y = rays_x[c] * z, rays_y[r] * z
            offset, limit = a * x + b * y + d * z, gate * sigma[r, c] * z * z
            here[c, 0], here[c, 1], here[c, 2], here[c, 3], here[c, 4] = x, y, z, offset, limit
            if c > 0 and here[c - 1, 4] > 0.0:
                e, f, g = normals[r, c - 1, 0], normals[r, c - 1, 1], normals[r, c - 1, 2]
                if a * e + b * f + d * g > cos_angle:
                    left = here[c - 1]
                    if abs(a * left[0] + b * left[1] + d * left[2] - offset) < limit and abs(e * x + f * y + g * z - left[3]) < limit:
                        links[r, c] |= 1
            if r > 0 and above[c, 4] > 0.0:
                e, f, g = normals[r - 1, c, 0], normals[r - 1, c, 1], normals[r - 1, c, 2]
                if a * e + b * f + d * g > cos_angle:
                    up = above[c]
                    if abs(a * up[0] + b * up[1] + d * up[2] - offset) < limit and abs(e * x + f * y + g * z - up[3]) < limit:
                        links[r, c] |= 2
    return links


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _root(parent: I32, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@numba.njit(cache=True, nogil=True, error_model="numpy")
def connected_components(links: U8, free: Bool) -> I32:
    """Component number of each cell (h, w), the number of its first cell; -1 for cells that are not `free`. `links` as from `smooth_links`."""
    h, w = links.shape
    parent = np.full(h * w, -1, np.int32)
    for r in range(h):
        for c in range(w):
            if not free[r, c]:
                continue
            i = r * w + c
            left, up = links[r, c] & 1 and free[r, c - 1], links[r, c] & 2 and free[r - 1, c]
            if left and up:
                a, b = _root(parent, i - 1), _root(parent, i - w)
                parent[i] = min(a, b)
                parent[max(a, b)] = min(a, b)
            elif left:
                parent[i] = parent[i - 1]
            elif up:
                parent[i] = parent[i - w]
            else:
                parent[i] = i
    for i in range(h * w):
        if parent[i] >= 0:
            parent[i] = parent[parent[i]]
    return parent.reshape(h, w)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cells_by_component(component: I32, least: int) -> tuple[I32, I32]:
    """Flat cell numbers grouped by component, for components of `least` cells or more, largest first; and the (k + 1,) starts of the groups."""
    flat = component.ravel()
    size = np.zeros(len(flat), np.int32)
    for i in flat:
        if i >= 0:
            size[i] += 1
    roots = np.flatnonzero(size >= least)
    roots = roots[np.argsort(-size[roots], kind="mergesort")]
    starts = np.zeros(len(roots) + 1, np.int32)
    place = np.full(len(flat), -1, np.int32)
    for k in range(len(roots)):
        place[roots[k]] = k
        starts[k + 1] = starts[k] + size[roots[k]]
    cells = np.empty(starts[-1], np.int32)
    cursor = starts.copy()
    for j in range(len(flat)):
        if flat[j] >= 0 and place[flat[j]] >= 0:
            k = place[flat[j]]
            cells[cursor[k]] = j
            cursor[k] += 1
    return cells, starts
