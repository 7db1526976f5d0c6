"""Kernels of depth images: depth at sub-pixel positions; grids of cells with inverse depth and normals, and their smooth connected components."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool
from trihedron.plugins.shared.sorting_kernels import descending


@kernel
def sigma_z(z: float, noise: tuple[float, float, float, float]) -> float:
    """Standard deviation of a depth reading z, metres."""
    a, b, c, floor = noise
    return max(floor, a + b * z + c * z * z)


@kernel
def local_depth(
    depth: F32, pixels: F32, radius: int, share: float, noise: tuple[float, float, float, float], gate: float, edge: float
) -> tuple[F32, F32]:
    """Depth at (n, 2) pixels and its standard deviation, both (n,) float32, NaN where it is not to be trusted.

    A linear surface is fitted to the (2 radius + 1)² neighbourhood, of which at least `share` must have depth. When all of it lies within `gate` σ_z
    of the fit, that is the depth. When some is off by less than `edge · z` more (a crease), the mean of the nearest pixels is, and σ grows.
    Else it is a depth edge."""
    out = np.full(len(pixels), np.nan, np.float32)
    sigma = np.full(len(pixels), np.nan, np.float32)
    least = max(share * (2 * radius + 1) ** 2, 3.0)
    for i in range(len(pixels)):
        u, v = float(pixels[i, 0]), float(pixels[i, 1])
        if not (abs(u) < 1e6 and abs(v) < 1e6):
            continue
        n, z, worst = _linear_fit(depth, u, v, radius)
        if n < least or z <= 0.0:
            continue
        s = sigma_z(z, noise)
        if worst <= gate * s:
            out[i], sigma[i] = z, s
        elif worst <= gate * s + edge * z:
            near, close, _ = _nearest_mean(depth, u, v)
            if near > 0:
                out[i], sigma[i] = close, np.sqrt(s * s + (close - z) ** 2)
    return out, sigma


@kernel
def _linear_fit(depth: F32, u: float, v: float, radius: int) -> tuple[int, float, float]:
    """Count, value at (u, v) and largest residual of the least-squares linear surface through the neighbourhood's depths."""
    rows, cols = depth.shape
    x, y = int(np.rint(u)), int(np.rint(v))
    x0, x1, y0, y1 = max(x - radius, 0), min(x + radius + 1, cols), max(y - radius, 0), min(y + radius + 1, rows)
    n, sx, sy, sxx, sxy, syy, sz, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(y0, y1):
        for c in range(x0, x1):
            z = float(depth[r, c])
            if 0.0 < z < np.inf:
                a, b = c - u, r - v
                n += 1.0
                sx += a
                sy += b
                sxx += a * a
                sxy += a * b
                syy += b * b
                sz += z
                sxz += a * z
                syz += b * z
    if n < 3.0:
        return int(n), 0.0, np.inf
    cxx, cxy, cyy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
    cxz, cyz = sxz - sx * sz / n, syz - sy * sz / n
    det = cxx * cyy - cxy * cxy
    if det < 1e-6:
        return 0, 0.0, np.inf
    gx, gy = (cyy * cxz - cxy * cyz) / det, (cxx * cyz - cxy * cxz) / det
    z0 = (sz - gx * sx - gy * sy) / n
    worst = 0.0
    for r in range(y0, y1):
        for c in range(x0, x1):
            z = float(depth[r, c])
            if 0.0 < z < np.inf:
                worst = max(worst, abs(z - z0 - gx * (c - u) - gy * (r - v)))
    return int(n), z0, worst


@kernel
def _nearest_mean(depth: F32, u: float, v: float) -> tuple[float, float, float]:
    """Weight, bilinear mean and spread of the (up to four) depths around (u, v)."""
    rows, cols = depth.shape
    x, y = int(np.floor(u)), int(np.floor(v))
    weight, mean, low, high = 0.0, 0.0, np.inf, 0.0
    for r in range(max(y, 0), min(y + 2, rows)):
        for c in range(max(x, 0), min(x + 2, cols)):
            z = float(depth[r, c])
            if 0.0 < z < np.inf:
                w = (1.0 - abs(c - u)) * (1.0 - abs(r - v))
                weight += w
                mean += w * z
                low, high = min(low, z), max(high, z)
    if weight < 1e-6:
        return 0.0, 0.0, 0.0
    return weight, mean / weight, high - low


# An organised depth image as a grid of cells: inverse depths, rays and normals, and the smooth surfaces it falls into.
#
# A plane `n·x + d = 0` is, along the ray r = (x/z, y/z, 1) of a cell, linear in inverse depth: `1 / z = q·r` with `q = -n / d`. The ray is exact and
# only z is noisy, so least squares in q with `σ = σ_z / z²` is unbiased and has a closed form.


class Grid(NamedTuple):
    """Cells of stride × stride pixels: inverse depth (0 = none), the σ of one reading of it and the number of readings, (h, w) each; x/z of the
    columns (w,) and y/z of the rows (h,); unit normals (h, w, 3), NaN = none."""

    rho: F32
    sigma: F32
    count: U8 | I32
    rays_x: F64
    rays_y: F64
    normals: F32


@kernel
def cell_inverse_depths(depth: F32, stride: int, edge: float, edge_m: float, noise: tuple[float, float, float, float]) -> tuple[F32, F32, U8]:
    """Inverse of the mean depth (h, w) of each block of stride × stride pixels, the σ of one reading of it, and the number of readings (255 at most).

    Where a block has no depth or a step of more than `edge` z + `edge_m` all three are 0."""
    rows, cols = depth.shape
    h, w = (rows + stride - 1) // stride, (cols + stride - 1) // stride
    rho, sigma, count = np.empty((h, w), np.float32), np.empty((h, w), np.float32), np.empty((h, w), np.uint8)
    strip = np.zeros((stride, w * stride), np.float32)  # the depths of a row of blocks, 0 = none
    for r in range(h):
        strip[:] = 0.0
        for y in range(r * stride, min((r + 1) * stride, rows)):
            for x in range(cols):
                strip[y - r * stride, x] = depth[y, x] if 0.0 < depth[y, x] < np.inf else np.float32(0.0)
        if stride == 2:  # a constant lets the compiler take several cells at once
            _cells_of_strip(strip, 2, edge, edge_m, noise, rho[r], sigma[r], count[r])
        else:
            _cells_of_strip(strip, stride, edge, edge_m, noise, rho[r], sigma[r], count[r])
    return rho, sigma, count


@kernel
def _cells_of_strip(
    strip: F32, stride: int, edge: float, edge_m: float, noise: tuple[float, float, float, float], rho: F32, sigma: F32, count: U8
) -> None:
    """A row of `cell_inverse_depths` from its depths (stride, w · stride), 0 = none."""
    for c in range(len(rho)):
        n, total, low, high = 0, 0.0, np.float32(np.inf), np.float32(0.0)
        for i in range(stride):
            for j in range(stride):
                z = strip[i, c * stride + j]
                n += z > 0.0
                total += z
                low, high = min(low, z if z > 0.0 else np.float32(np.inf)), max(high, z)
        whole = (n > 0) & (high - low <= edge * low + edge_m)
        mean = total / n
        rho[c] = 1.0 / mean if whole else 0.0
        sigma[c] = sigma_z(mean, noise) / (mean * mean) if whole else 0.0
        count[c] = n if whole else 0


@kernel
def cell_rays(h: int, w: int, stride: int, intrinsics: tuple[float, float, float, float]) -> tuple[F64, F64]:
    """x/z of each column (w,) and y/z of each row (h,) at the centres of the cells' blocks."""
    fx, fy, cx, cy = intrinsics
    centre = 0.5 * (stride - 1)
    return (np.arange(w) * stride + centre - cx) / fx, (np.arange(h) * stride + centre - cy) / fy


@kernel
def coarser(grid: Grid, edge: float, edge_m: float) -> Grid:
    """The grid of 2 × 2 cells: mean inverse depth and mean normal of those that have one, none across a step of more than `edge` z + `edge_m`."""
    rho, sigma, count, rays_x, rays_y, normals = grid
    rows, cols = rho.shape
    h, w = (rows + 1) // 2, (cols + 1) // 2
    rho2, sigma2, count2 = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32), np.zeros((h, w), np.int32)
    normals2, x2, y2 = np.empty((h, w, 3), np.float32), np.empty(w), np.empty(h)
    for c in range(w):
        x2[c] = 0.5 * (rays_x[2 * c] + rays_x[min(2 * c + 1, cols - 1)])
    depths, counts, around = np.zeros((2, 2, 2 * w), np.float32), np.zeros((2, 2 * w), np.int32), np.zeros((3, 2, 2 * w), np.float32)  # of two rows
    normal = np.empty((3, w), np.float32)
    for r in range(h):
        y2[r] = 0.5 * (rays_y[2 * r] + rays_y[min(2 * r + 1, rows - 1)])
        for i in range(2):
            if 2 * r + i == rows:
                depths[:, 1], counts[1], around[:, 1] = 0.0, 0, 0.0
                continue
            here = normals[2 * r + i]
            for c in range(cols):
                depths[0, i, c], depths[1, i, c], counts[i, c] = rho[2 * r + i, c], sigma[2 * r + i, c], count[2 * r + i, c]
            for c in range(cols):
                known = (depths[0, i, c] > 0.0) & (here[c, 0] == here[c, 0])
                for k in range(3):
                    around[k, i, c] = here[c, k] if known else np.float32(0.0)
        _mean_depths(depths[0], depths[1], counts, edge, edge_m, rho2[r], sigma2[r], count2[r])
        _mean_normals(around[0], around[1], around[2], count2[r], normal[0], normal[1], normal[2])
        for c in range(w):
            for k in range(3):
                normals2[r, c, k] = normal[k, c]
    return Grid(rho2, sigma2, count2, x2, y2, normals2)


@kernel
def _mean_depths(rho: F32, sigma: F32, count: I32, edge: float, edge_m: float, rho2: F32, sigma2: F32, count2: I32) -> None:
    """A row (w,) of the depths of `coarser` from two rows (2, 2 w), 0 = none."""
    for c in range(len(rho2)):
        n, total, error, low, high = 0, 0.0, 0.0, np.inf, 0.0
        for i in range(2):
            for j in range(2):
                p, m = rho[i, 2 * c + j], count[i, 2 * c + j]
                n += m
                total += m * p
                error += m * sigma[i, 2 * c + j]
                low, high = min(low, p if p > 0.0 else np.inf), max(high, p)
        whole = (n > 0) & (1.0 / low - 1.0 / high <= edge / high + edge_m)
        rho2[c], sigma2[c], count2[c] = total / n if whole else 0.0, error / n if whole else 0.0, n if whole else 0


@kernel
def _mean_normals(x: F32, y: F32, z: F32, count: I32, x2: F32, y2: F32, z2: F32) -> None:
    """A row (w,) of the normals of `coarser` from two rows (2, 2 w), 0 = none."""
    for c in range(len(count)):
        nx, ny, nz = 0.0, 0.0, 0.0
        for i in range(2):
            for j in range(2):
                nx, ny, nz = nx + x[i, 2 * c + j], ny + y[i, 2 * c + j], nz + z[i, 2 * c + j]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        length = length if (length > 0.0) & (count[c] > 0) else np.nan
        x2[c], y2[c], z2[c] = nx / length, ny / length, nz / length


@kernel
def smooth_links(grid: Grid, cos_angle: float, gate: float) -> U8:
    """(h, w) bits: 1 = the cell lies on one smooth surface with its left neighbour, 2 = with the upper one.

    Their normals differ by less than the angle and each lies within `gate` σ_z of the other's tangent plane (Trevor et al. 2013)."""
    rho, sigma, rays_x, rays_y, normals = grid.rho, grid.sigma, grid.rays_x, grid.rays_y, grid.normals
    h, w = rho.shape
    links = np.zeros((h, w), np.uint8)
    here, above = np.zeros((5, w)), np.zeros((5, w))  # point, offset n·x of the tangent plane, limit of the offsets; the limit is 0 without depth
    normal, upper, bits = np.empty((3, w), np.float32), np.empty((3, w), np.float32), np.zeros(w, np.uint8)
    for r in range(h):
        here, above, normal, upper = above, here, upper, normal
        for c in range(w):
            for k in range(3):
                normal[k, c] = normals[r, c, k]
        _tangent_planes(rho[r], sigma[r], rays_x, rays_y[r], normal, gate, here)
        if r > 0:
            _link_cells(here, normal, above, upper, cos_angle, bits)
            for c in range(w):
                links[r, c] = 2 * bits[c]
        _link_cells(here[:, 1:], normal[:, 1:], here[:, :-1], normal[:, :-1], cos_angle, bits[1:])
        for c in range(1, w):
            links[r, c] |= bits[c]
    return links


@kernel
def _tangent_planes(rho: F32, sigma: F32, rays_x: F64, ray_y: float, normal: F32, gate: float, out: F64) -> None:
    """Point, offset of the tangent plane and limit (5, w) of a row of cells, as in `smooth_links`."""
    xs, ys, zs, offsets, limits, a, b, d = out[0], out[1], out[2], out[3], out[4], normal[0], normal[1], normal[2]
    for c in range(len(rho)):
        z = 1.0 / rho[c]
        x, y = rays_x[c] * z, ray_y * z
        xs[c], ys[c], zs[c] = x, y, z
        offsets[c] = a[c] * x + b[c] * y + d[c] * z
    for c in range(len(rho)):
        limits[c] = gate * sigma[c] * zs[c] * zs[c] if (rho[c] > 0.0) & (a[c] == a[c]) else 0.0


@kernel
def _link_cells(one: F64, normal: F32, other: F64, normal2: F32, cos_angle: float, out: U8) -> None:
    """1 where cells lie on one smooth surface with others, whose offsets may be as far off as the limit of the ones."""
    for c in range(out.size):
        a, b, d, e, f, g = normal[0, c], normal[1, c], normal[2, c], normal2[0, c], normal2[1, c], normal2[2, c]
        limit = one[4, c]
        there = a * other[0, c] + b * other[1, c] + d * other[2, c] - one[3, c]
        here = e * one[0, c] + f * one[1, c] + g * one[2, c] - other[3, c]
        alike = (limit > 0.0) & (other[4, c] > 0.0) & (a * e + b * f + d * g > cos_angle)
        out[c] = alike & (abs(there) < limit) & (abs(here) < limit)


@kernel
def _root(parent: I32, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
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
            if left and up and parent[i - 1] == parent[i - w]:
                parent[i] = parent[i - 1]
            elif left and up:
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


@kernel
def cells_by_component(component: I32, least: int) -> tuple[I32, I32]:
    """Flat cell numbers grouped by component, for components of `least` cells or more, largest first; and the (k + 1,) starts of the groups."""
    flat = component.ravel()
    size = np.zeros(len(flat), np.int32)
    for i in flat:
        if i >= 0:
            size[i] += 1
    roots = np.flatnonzero(size >= least)
    roots = roots[descending(size[roots].astype(np.float64))]
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
