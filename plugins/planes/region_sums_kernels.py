"""Kernels that sum over the cells of labelled regions: normal equations, moments, areas, and the selection of the largest."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8
from trihedron.plugins.shared.depth_image_kernels import Grid
from trihedron.plugins.shared.sorting_kernels import descending


@kernel
def accumulate(labels: U8, regions: int, grid: Grid) -> tuple[F64, F64, F64, I32]:
    """Sum over each region's cells, all of which have depth, weighted by their number of depths.

    Returns: the normal equations of q, (k, 3, 3) and (k, 3), with `σ = σ_z / z²`; the moments `Σ [x;1][x;1]ᵀ / σ_z²` (k, 4, 4); and the number of
    depths (k,)."""
    rho, sigma, count, rays_x, rays_y, _ = grid
    sums, n = np.zeros((regions + 1, 19)), np.zeros(regions + 1, np.int32)  # upper triangles of A and M, row by row, and b between them
    h, w = labels.shape
    row = np.empty((5, w))  # x/z, inverse depth, depth and weights
    for c in range(w):
        row[0, c] = rays_x[c]
    for r in range(h):
        weigh_cells(sigma[r], count[r], row[3])
        for c in range(w):
            p = float(rho[r, c])
            row[1, c], row[2, c], row[4, c] = p, 1.0 / p, row[3, c] * p * p * p * p
        c = 0
        while c < w:
            k, first, depths = labels[r, c], c, 0
            while c < w and labels[r, c] == k:
                c += 1
            if k > 0:
                for readings in count[r, first:c]:
                    depths += readings
                n[k] += depths
                _add_stretch(row[:, first:c], rays_y[r], sums[k])
    A, b, M = np.empty((regions, 3, 3)), sums[1:, 6:9].copy(), np.empty((regions, 4, 4))
    for k in range(regions):
        _symmetric(sums[k + 1, :6], A[k])
        _symmetric(sums[k + 1, 9:], M[k])
    return A, b, M, n[1:].copy()


@kernel
def _add_stretch(cells: F64, y: float, sums: F64) -> None:
    """Add n neighbouring cells of a row, (5, n) of x/z, inverse depth, depth and the two weights, to the sums (19,) of their region; the sums stay in
    registers meanwhile."""
    xs, ps, zs, weights, moments = cells[0], cells[1], cells[2], cells[3], cells[4]
    xx, xy, x1, yy, y1, one, xp, yp, p1 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8]
    XX, XY, XZ, X1, YY, YZ, Y1, ZZ, Z1, ONE = sums[9], sums[10], sums[11], sums[12], sums[13], sums[14], sums[15], sums[16], sums[17], sums[18]
    for c in range(len(xs)):
        x, p, z, weight, moment = xs[c], ps[c], zs[c], weights[c], moments[c]
        px, py = x * z, y * z
        xx, xy, x1 = xx + weight * x * x, xy + weight * x * y, x1 + weight * x
        yy, y1, one = yy + weight * y * y, y1 + weight * y, one + weight
        xp, yp, p1 = xp + weight * x * p, yp + weight * y * p, p1 + weight * p
        XX, XY, XZ, X1 = XX + moment * px * px, XY + moment * px * py, XZ + moment * px * z, X1 + moment * px
        YY, YZ, Y1 = YY + moment * py * py, YZ + moment * py * z, Y1 + moment * py
        ZZ, Z1, ONE = ZZ + moment * z * z, Z1 + moment * z, ONE + moment
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8] = xx, xy, x1, yy, y1, one, xp, yp, p1
    sums[9], sums[10], sums[11], sums[12], sums[13], sums[14], sums[15], sums[16], sums[17], sums[18] = XX, XY, XZ, X1, YY, YZ, Y1, ZZ, Z1, ONE


@kernel
def weigh_cells(sigma: F32, count: U8, out: F64) -> None:
    """Weights (w,) of a row's inverse depths, inf or NaN without any."""
    for c in range(len(out)):
        out[c] = np.int32(count[c]) / (float(sigma[c]) * sigma[c])


@kernel
def _symmetric(upper: F64, out: F64) -> None:
    """Fill a square matrix from its upper triangle, row by row."""
    k = 0
    for i in range(len(out)):
        for j in range(i, len(out)):
            out[i, j] = out[j, i] = upper[k]
            k += 1


@kernel
def areas(labels: U8, count: U8, regions: int) -> I32:
    """Count (k,) the depths in each region's cells."""
    out, flat, counts = np.zeros(regions + 1, np.int32), labels.ravel(), count.ravel()
    label, n = 0, 0  # of the stretch of one region: a sum in memory would wait for the one before
    for i in range(len(flat)):
        if flat[i] != label:
            out[label] += n
            label, n = flat[i], 0
        n += counts[i]
    out[label] += n
    return out[1:]


@kernel
def largest_regions(labels: U8, owner: I32, count: U8 | I32, least: int, most: int) -> tuple[U8, U8, I32, I32]:
    """Select the regions of at least `least` depths, `most` at most, and number them 1 … n from the largest; `owner` (k + 1,) is the region of each
    label, 0 = none.

    Returns: the labels (h, w) by these numbers, 0 = none; the number (k + 1,) of each old label; index (n,) and depths (n,) of each region."""
    area, single = np.zeros(len(owner)), areas(labels, count, len(owner) - 1)
    for k in range(1, len(owner)):
        area[owner[k]] += single[k - 1]
    ranked, size, number = np.empty(most, np.int32), np.empty(most, np.int32), np.zeros(len(owner), np.uint8)
    found = 0
    for k in descending(area[1:].copy()):
        if found < most and area[k + 1] >= least:
            ranked[found], size[found], number[k + 1] = k, np.int32(area[k + 1]), found + 1
            found += 1
    number = number[owner]
    out, flat = np.empty(labels.shape, np.uint8), labels.ravel()
    numbered = out.ravel()
    for i in range(len(flat)):
        numbered[i] = number[flat[i]]
    return out, number, ranked[:found].copy(), size[:found].copy()
