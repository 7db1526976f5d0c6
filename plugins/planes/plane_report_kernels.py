"""Kernels that report planes: coefficients, their derivative by q, the excess of their variance over the noise model's, and sample points."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import tangent_columns
from trihedron.pipeline.core.types import F32, F64, I32, U8
from trihedron.plugins.planes.region_sums_kernels import weigh_cells
from trihedron.plugins.shared.depth_image_kernels import Grid

STEP_M = 2.0**-10  # resolution of samples; centimetres would do, and fewer digits compress better


@kernel
def plane_report(
    labels: U8, core: U8, number: U8, planes: F64, grid: Grid, tiles: int, expected: float, weight: float, wanted: int, most: int
) -> tuple[F64, F64, F64, F32]:
    """Report planes q (k, 3) whose regions are labelled (h, w); `number` is the region of each label of `core`, 0 = none.

    Returns: the coefficients (k, 4), the Jacobian (k, 3, 3) of (a, b, d) by q, the variance (k,) as from `excess_variance` and the samples
    (k, wanted, 3) as from `spread_samples`."""
    coefficients, J = np.empty((len(planes), 4)), np.empty((len(planes), 3, 3))
    for k in range(len(planes)):
        x, y, z = planes[k, 0], planes[k, 1], planes[k, 2]
        d = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-12)
        coefficients[k, 0], coefficients[k, 1], coefficients[k, 2], coefficients[k, 3] = -x * d, -y * d, -z * d, d
        tangent_columns(coefficients[k], J[k].T)
        for i in range(3):
            J[k, 0, i], J[k, 1, i], J[k, 2, i] = -d * J[k, 0, i], -d * J[k, 1, i], d * d * coefficients[k, i]
    variance = excess_variance(core, number, planes, grid, tiles, expected, weight)
    return coefficients, J, variance, spread_samples(labels, planes, grid.rays_x, grid.rays_y, wanted, most)


@kernel
def spread_samples(labels: U8, planes: F64, rays_x: F64, rays_y: F64, wanted: int, most: int) -> F32:
    """Sample points (k, wanted, 3) on each plane, spread over its region by farthest-point sampling among about `most` cells; rounded to half a
    millimetre, padded with NaN."""
    regions = len(planes)
    h, w = labels.shape
    size = _sizes(labels, np.arange(regions + 1).astype(np.uint8), regions)
    out = np.full((regions, wanted, 3), np.nan, np.float32)
    points, used, seen = np.empty((regions, 3, most + 1)), np.zeros(regions, np.int32), np.zeros(regions, np.int32)
    due = np.ceil(0.5 * size / most).astype(np.int32)  # the first of a region's cells, by their number, that is one of `most` spread evenly
    for r in range(h):
        c = 0
        while c < w:
            label, first = labels[r, c], c
            while c < w and labels[r, c] == label:
                c += 1
            if label == 0:
                continue
            k = label - 1
            while due[k] <= seen[k] + c - first and used[k] <= most:
                x, y = rays_x[first + due[k] - seen[k] - 1], rays_y[r]
                p = planes[k, 0] * x + planes[k, 1] * y + planes[k, 2]
                if p > 1e-6:
                    points[k, 0, used[k]], points[k, 1, used[k]], points[k, 2, used[k]] = x / p, y / p, 1.0 / p
                    used[k] += 1
                due[k] = max(due[k] + 1, int(np.ceil((used[k] + 0.5) * size[k] / most)))
            seen[k] += c - first
    for k in range(regions):
        _farthest_points(points[k, 0, : used[k]], points[k, 1, : used[k]], points[k, 2, : used[k]], out[k])
    return out


@kernel
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


@kernel
def _sizes(labels: U8, number: U8, regions: int) -> I32:
    """Count (k,) the cells of each region; `number` is the region 1 … k of each label, 0 = none."""
    out, flat = np.zeros(regions + 1, np.int32), labels.ravel()
    label, first = 0, 0
    for i in range(len(flat)):
        if flat[i] != label:
            out[number[label]] += i - first
            label, first = flat[i], i
    out[number[label]] += len(flat) - first
    return out[1:]


@kernel
def excess_variance(labels: U8, number: U8, planes: F64, grid: Grid, tiles: int, expected: float, weight: float) -> F64:
    """Estimate (k,) the variance of a patch's mean residual in each region, relative to independent depths with the noise model's σ. All cells of the
    regions have depth; `number` is the region of each label, 0 = none.

    A region is cut into about `tiles` square tiles; with e the residuals and w the weights of a tile's cells the ratio is `Σ (Σ w e)² / Σ Σ w`, for
    the three parameters fitted corrected, and shrunk towards `expected` with the weight of that many tiles. It measures what makes plane fits worse
    than their least-squares covariance: correlated noise, quantisation, lens distortion and surfaces that are not quite plane."""
    rho, sigma, count, rays_x, rays_y, _ = grid
    h, w = labels.shape
    regions = len(planes)
    side = np.maximum(np.sqrt(_sizes(labels, number, regions) / tiles), 2.0)
    across = (w / side).astype(np.int64) + 1
    start = np.zeros(regions + 1, np.int64)
    for k in range(regions):
        start[k + 1] = start[k] + across[k] * (int(h / side[k]) + 1)
    total, information = np.zeros(start[-1] + 1), np.zeros(start[-1] + 1)
    ends = np.empty((regions, w // 2 + 2), np.int32)  # first column after each tile of a row
    for k in range(regions):
        for c in range(w):
            ends[k, int(c / side[k])] = c + 1
    weights = np.empty(w)
    for r in range(h):
        weigh_cells(sigma[r], count[r], weights)
        c = 0
        while c < w:
            label, first = labels[r, c], c
            while c < w and labels[r, c] == label:
                c += 1
            if number[label] == 0:
                continue
            k = number[label] - 1
            u, v, one = planes[k, 0], planes[k, 1], planes[k, 2]
            column, row = int(first / side[k]), start[k] + int(r / side[k]) * across[k]
            while first < c:
                end, t = min(ends[k, column], c), row + column
                residual, inverse, ps, xs, ws = total[t], information[t], rho[r, first:end], rays_x[first:end], weights[first:end]
                for i in range(end - first):
                    residual += ws[i] * (ps[i] - u * xs[i] - v * rays_y[r] - one)
                    inverse += ws[i]
                total[t], information[t] = residual, inverse
                first, column = end, column + 1
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
