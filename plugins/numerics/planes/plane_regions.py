"""Labelled planar regions on a grid: growth to their borders, and what is reported of them."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, U8
from trihedron.plugins.numerics.algebra.ranking import descending
from trihedron.plugins.numerics.depth.organised_grid import Grid

STEP_M = 2.0**-10  # samples of planes say where a plane is, to within centimetres: fewer digits, shorter recordings


@numba.njit(cache=True, nogil=True, error_model="numpy")
def grow_regions(labels: I32, planes: F64, grid: Grid, gate: float, reach: int, cos_cone: float) -> I32:
    """Labels (h, w), grown ring by ring into unlabelled cells whose depth is within `gate` σ of the neighbouring region's q; returns a copy.

    A cell goes to the plane that explains it best. For `reach` rings normals do not count (they are blurred or missing near a border); beyond, a
    normal must be missing or lie within the cone."""
    rho, sigma, _, rays_x, rays_y, normals = grid
    h, w = labels.shape
    out = labels.copy()
    offered = np.zeros((h, w), np.int32)
    residual = np.empty((h, w), np.float32)
    frontier = _border(labels)
    nearby = np.empty(h * w, np.int32)
    unit = np.empty_like(planes)
    for k in range(len(planes)):
        unit[k] = -planes[k] / max(np.sqrt(planes[k] @ planes[k]), 1e-12)
    ring = 0
    while len(frontier) > 0:
        m = 0
        for i in frontier:
            r, c = i // w, i % w
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
            out[i // w, i % w] = offered[i // w, i % w]
        ring += 1
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _border(labels: I32) -> I32:
    """Flat numbers of the labelled cells beside unlabelled ones."""
    h, w = labels.shape
    out, n = np.empty(h * w, np.int32), 0
    for r in range(h):
        for c in range(w):
            if labels[r, c] == 0:
                continue
            if (
                (c > 0 and labels[r, c - 1] == 0)
                or (c < w - 1 and labels[r, c + 1] == 0)
                or (r > 0 and labels[r - 1, c] == 0)
                or (r < h - 1 and labels[r + 1, c] == 0)
            ):
                out[n] = r * w + c
                n += 1
    return out[:n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def accumulate(labels: I32, regions: int, grid: Grid) -> tuple[F64, F64, F64, I32]:
    """Sums over each region's cells, weighted by their number of depths: the normal equations of q (k, 3, 3) and (k, 3) with `σ = σ_z / z²`, the
    moments `Σ [x;1][x;1]ᵀ / σ_z²` (k, 4, 4), and the number of depths (k,)."""
    rho, sigma, count, rays_x, rays_y, _ = grid
    sums, n = np.zeros((regions + 1, 19)), np.zeros(regions + 1, np.int32)  # upper triangles of A and M, row by row, and b between them
    h, w = labels.shape
    row, weights = np.empty((5, w)), np.empty(w)  # x/z, inverse depth, depth and weights, 0 = no depth
    row[0] = rays_x
    for r in range(h):
        _weigh_cells(sigma[r], count[r], weights)
        for c in range(w):
            p = float(rho[r, c])
            known = p > 0.0
            row[1, c], row[2, c], row[3, c] = p, 1.0 / p if known else 0.0, weights[c] if known else 0.0
            row[4, c] = weights[c] * p * p * p * p if known else 0.0
        c = 0
        while c < w:
            k, first = labels[r, c], c
            while c < w and labels[r, c] == k:
                n[k] += count[r, c]
                c += 1
            if k > 0:
                _add_stretch(row, first, c, rays_y[r], sums[k])
    A, b, M = np.empty((regions, 3, 3)), sums[1:, 6:9].copy(), np.empty((regions, 4, 4))
    for k in range(regions):
        _symmetric(sums[k + 1, :6], A[k])
        _symmetric(sums[k + 1, 9:], M[k])
    return A, b, M, n[1:].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_stretch(row: F64, first: int, end: int, y: float, sums: F64) -> None:
    """Add the cells first … end of a row to the sums (19,) of their region, which do not go through memory meanwhile."""
    xx, xy, x1, yy, y1, one, xp, yp, p1 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8]
    XX, XY, XZ, X1, YY, YZ, Y1, ZZ, Z1, ONE = sums[9], sums[10], sums[11], sums[12], sums[13], sums[14], sums[15], sums[16], sums[17], sums[18]
    for c in range(first, end):
        x, p, z, weight, moment = row[0, c], row[1, c], row[2, c], row[3, c], row[4, c]
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
def _weigh_cells(sigma: F32, count: I32, out: F64) -> None:
    """Weights (w,) of a row's inverse depths, inf or NaN without any."""
    for c in range(len(out)):
        out[c] = count[c] / (float(sigma[c]) * sigma[c])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _symmetric(upper: F64, out: F64) -> None:
    """Fill a square matrix from its upper triangle, row by row."""
    k = 0
    for i in range(len(out)):
        for j in range(i, len(out)):
            out[i, j] = out[j, i] = upper[k]
            k += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def areas(labels: I32, count: I32, regions: int) -> I32:
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
def _sizes(labels: U8, regions: int) -> I32:
    """(k + 1,) number of cells with each label."""
    out, flat = np.zeros(regions + 1, np.int32), labels.ravel()
    label, first = 0, 0
    for i in range(len(flat)):
        if flat[i] != label:
            out[label] += i - first
            label, first = flat[i], i
    out[label] += len(flat) - first
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def largest_regions(labels: I32, core: I32, owner: I32, count: I32, least: int, most: int) -> tuple[U8, U8, I32, I32]:
    """The regions of at least `least` depths, `most` at most, as 1 … k from the largest: `labels` and `core` (h, w) by these numbers, 0 = none, which
    of the regions each is, and its number of depths. `owner` (k + 1,) says which region a label belongs to, 0 = none."""
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
    out, middle = np.empty(labels.shape, np.uint8), np.empty(labels.shape, np.uint8)
    for old, new in ((labels.ravel(), out.ravel()), (core.ravel(), middle.ravel())):
        for i in range(len(old)):
            new[i] = number[old[i]]
    return out, middle, ranked[:found].copy(), size[:found].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def spread_samples(labels: U8, planes: F64, rays_x: F64, rays_y: F64, wanted: int, most: int) -> F32:
    """(k, wanted, 3) points of each plane, on its q to half a millimetre, and spread over its region by farthest-point choice among (about) `most`
    cells; NaN-padded."""
    regions = len(planes)
    h, w = labels.shape
    size = _sizes(labels, regions)
    out = np.full((regions, wanted, 3), np.nan, np.float32)
    points, used, seen = np.empty((regions, 3, most + 1)), np.zeros(regions, np.int32), np.zeros(regions, np.int32)
    for r in range(h):
        for c in range(w):
            k = labels[r, c] - 1
            if k < 0:
                continue
            seen[k] += 1
            if seen[k] * most < (used[k] + 0.5) * size[k + 1] or used[k] > most:
                continue
            p = planes[k, 0] * rays_x[c] + planes[k, 1] * rays_y[r] + planes[k, 2]
            if p > 1e-6:
                points[k, 0, used[k]], points[k, 1, used[k]], points[k, 2, used[k]] = rays_x[c] / p, rays_y[r] / p, 1.0 / p
                used[k] += 1
    for k in range(regions):
        _farthest_points(points[k, 0, : used[k]], points[k, 1, : used[k]], points[k, 2, : used[k]], out[k])
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _farthest_points(xs: F64, ys: F64, zs: F64, out: F32) -> None:
    """Fill the rows of `out`, each the point farthest from those before it, beginning at the middle of the list."""
    n = len(xs)
    distance = np.full(n, np.inf)
    ordered = distance.view(np.int64)  # numbers above 0 are ordered like their bits, and of integers the compiler compares several at once
    chosen = n // 2
    for k in range(min(n, len(out))):
        x, y, z = xs[chosen], ys[chosen], zs[chosen]
        out[k, 0], out[k, 1], out[k, 2] = np.rint(x / STEP_M) * STEP_M, np.rint(y / STEP_M) * STEP_M, np.rint(z / STEP_M) * STEP_M
        for i in range(n):
            e = (xs[i] - x) ** 2 + (ys[i] - y) ** 2 + (zs[i] - z) ** 2
            distance[i] = min(distance[i], e)
        best = ordered[0]
        for i in range(n):
            best = max(best, ordered[i])
        chosen = 0
        while ordered[chosen] < best:
            chosen += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def excess_variance(labels: I32, planes: F64, grid: Grid, tiles: int, expected: float, weight: float) -> F64:
    """(k,) variance of the mean of a patch of each region over what independent depths with the noise model's σ would give.

    A region is cut into about `tiles` square tiles; with e the residuals and w the weights of a tile's cells the ratio is `Σ (Σ w e)² / Σ Σ w`, for
    the three parameters fitted corrected, and shrunk towards `expected` with the weight of that many tiles. It measures what makes plane fits worse
    than their least-squares covariance: correlated noise, quantisation, lens distortion and surfaces that are not quite plane."""
    rho, sigma, count, rays_x, rays_y, _ = grid
    h, w = labels.shape
    regions = len(planes)
    side = np.maximum(np.sqrt(_sizes(labels, regions)[1:] / tiles), 2.0)
    across = (w / side).astype(np.int64) + 1
    start = np.zeros(regions + 1, np.int64)
    for k in range(regions):
        start[k + 1] = start[k] + across[k] * (int(h / side[k]) + 1)
    total, information = np.zeros(start[-1] + 1), np.zeros(start[-1] + 1)
    column, row = np.empty((regions, w), np.int64), np.empty(regions, np.int64)  # tiles of each column, and of the row begun
    for k in range(regions):
        for c in range(w):
            column[k, c] = int(c / side[k])
    weights = np.empty(w)
    for r in range(h):
        _weigh_cells(sigma[r], count[r], weights)
        for k in range(regions):
            row[k] = start[k] + int(r / side[k]) * across[k]
        tile, residual, inverse = 0, total[0], information[0]  # of the tile that the cells before lie in
        for c in range(w):
            k = labels[r, c] - 1
            if k >= 0 and rho[r, c] > 0.0:
                t = row[k] + column[k, c]
                if t != tile:
                    total[tile], information[tile] = residual, inverse
                    tile, residual, inverse = t, total[t], information[t]
                residual += weights[c] * (rho[r, c] - planes[k, 0] * rays_x[c] - planes[k, 1] * rays_y[r] - planes[k, 2])
                inverse += weights[c]
        total[tile], information[tile] = residual, inverse
    out = np.full(regions, expected)
    for k in range(regions):
        a, b, c = 0.0, 0.0, 0.0
        for t in range(start[k], start[k + 1]):
            a += total[t] * total[t]
            b += information[t]
            c += information[t] * information[t]
        if c > 0.0:
            effective = b * b / c
            out[k] = (a / b * effective + expected * weight) / (max(effective - 3.0, 0.0) + weight)
    return out
