"""Labelled planar regions on a grid: growth to their borders, sums over their cells, and which are the largest."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, U8
from trihedron.plugins.numerics.algebra.ranking import descending
from trihedron.plugins.numerics.depth.organised_grid import Grid


@numba.njit(cache=True, nogil=True, error_model="numpy")
def grow_regions(labels: U8, planes: F64, grid: Grid, gate: float, reach: int, cos_cone: float) -> U8:
    """Labels (h, w), grown ring by ring into unlabelled cells whose depth is within `gate` σ of the neighbouring region's q; returns a copy.

    A cell goes to the plane that explains it best. For `reach` rings normals do not count (they are blurred or missing near a border); beyond, a
    normal must be missing or lie within the cone."""
    rho, sigma, _, rays_x, rays_y, normals = grid
    h, w = labels.shape
    out = labels.copy()
    offered = np.zeros((h, w), np.uint8)
    residual = np.empty((h, w), np.float32)
    flat, flat_offered = out.ravel(), offered.ravel()
    frontier = _border(labels)
    nearby = np.empty(h * w, np.int32)
    unit = np.empty_like(planes)
    for k in range(len(planes)):
        unit[k] = -planes[k] / max(np.sqrt(planes[k] @ planes[k]), 1e-12)
    ring = 0
    while len(frontier) > 0:
        m = 0
        for i in frontier:
            r = i // w
            c = i - r * w
            label = out[r, c]
            k = label - 1
            for s, d in ((r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)):
                if s < 0 or s >= h or d < 0 or d >= w or out[s, d] != 0 or rho[s, d] <= 0.0:
                    continue
                p = rho[s, d]
                e = abs(planes[k, 0] * rays_x[d] + planes[k, 1] * rays_y[s] + planes[k, 2] - p) / sigma[s, d]
                if e > gate:
                    continue
                if ring >= reach:
                    facing = normals[s, d, 0] * unit[k, 0] + normals[s, d, 1] * unit[k, 1] + normals[s, d, 2] * unit[k, 2]
                    if facing < cos_cone:
                        continue
                if offered[s, d] == 0:
                    nearby[m] = s * w + d
                    m += 1
                elif e > residual[s, d] or (e == residual[s, d] and label > offered[s, d]):
                    continue
                offered[s, d], residual[s, d] = label, e
        frontier = nearby[:m].copy()
        for i in frontier:
            flat[i] = flat_offered[i]
        ring += 1
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _border(labels: U8) -> I32:
    """Flat numbers of the labelled cells beside unlabelled ones."""
    h, w = labels.shape
    out, n = np.empty(h * w, np.int32), 0
    beside = np.empty(w, np.bool_)
    for r in range(h):
        here, above, below = labels[r], labels[max(r - 1, 0)], labels[min(r + 1, h - 1)]
        for c in range(w):
            beside[c] = (here[c] > 0) & ((above[c] == 0) | (below[c] == 0))
        for c in range(w - 1):
            beside[c] |= (here[c] > 0) & (here[c + 1] == 0)
        for c in range(1, w):
            beside[c] |= (here[c] > 0) & (here[c - 1] == 0)
        for c in range(w):
            if beside[c]:
                out[n] = r * w + c
                n += 1
    return out[:n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def accumulate(labels: U8, regions: int, grid: Grid) -> tuple[F64, F64, F64, I32]:
    """Sums over each region's cells, all of which have depth, weighted by their number of depths: the normal equations of q (k, 3, 3) and (k, 3) with
    `σ = σ_z / z²`, the moments `Σ [x;1][x;1]ᵀ / σ_z²` (k, 4, 4), and the number of depths (k,)."""
    rho, sigma, count, rays_x, rays_y, _ = grid
    sums, n = np.zeros((regions + 1, 19)), np.zeros(regions + 1, np.int32)  # upper triangles of A and M, row by row, and b between them
    h, w = labels.shape
    row = np.empty((5, w))  # x/z, inverse depth, depth and weights
    row[0] = rays_x
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_stretch(columns: F64, y: float, sums: F64) -> None:
    """Add cells beside each other, by x/z, inverse depth, depth and weights (5, n), to the sums (19,) of their region, which do not go through
    memory meanwhile."""
    xs, ps, zs, weights, moments = columns[0], columns[1], columns[2], columns[3], columns[4]
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def weigh_cells(sigma: F32, count: U8, out: F64) -> None:
    """Weights (w,) of a row's inverse depths, inf or NaN without any."""
    for c in range(len(out)):
        out[c] = np.int32(count[c]) / (float(sigma[c]) * sigma[c])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _symmetric(upper: F64, out: F64) -> None:
    """Fill a square matrix from its upper triangle, row by row."""
    k = 0
    for i in range(len(out)):
        for j in range(i, len(out)):
            out[i, j] = out[j, i] = upper[k]
            k += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def areas(labels: U8, count: U8, regions: int) -> I32:
    """(k,) number of depths in each region's cells."""
    out, flat, counts = np.zeros(regions + 1, np.int32), labels.ravel(), count.ravel()
    label, n = 0, 0  # of the stretch of one region: a sum in memory would wait for the one before
    for i in range(len(flat)):
        if flat[i] != label:
            out[label] += n
            label, n = flat[i], 0
        n += counts[i]
    out[label] += n
    return out[1:]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def largest_regions(labels: U8, owner: I32, count: U8, least: int, most: int) -> tuple[U8, U8, I32, I32]:
    """The regions of at least `least` depths, `most` at most, as 1 … k from the largest: `labels` (h, w) by these numbers, 0 = none, the number of
    each label, which of the regions each is, and its number of depths. `owner` (k + 1,) says which region a label belongs to, 0 = none."""
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


