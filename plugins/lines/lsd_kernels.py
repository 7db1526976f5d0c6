"""Numba kernels of `lsd.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8

# Straight line segments as regions of pixels whose level lines run alike (von Gioi et al., PAMI 2010; IPOL 2012).

BINS = 1024  # of gradient magnitude, by which pixels are taken in order


class LevelLines(NamedTuple):
    """Level lines of an image (h, w): x and y (2 h · w,) of unit vectors along them (dark on the right) of the pixels that are free to be taken, NaN
    of others, and gradient magnitudes (h · w,)."""

    image: U8
    free: F32
    magnitude: F32


@kernel
def line_support_segments(image: U8, tolerance: float, quantisation: float, density: float) -> F64:
    """(n, 4) end points (x, y, x, y) of the segments of an image (h, w), pixel centres at integers, strongest seed first.

    `tolerance`, rad, is between the level line of a pixel and the mean of its region; gradients that `quantisation` grey levels could turn by more do
    not count; `density` is the least share of a region's rectangle that it must fill: a bent region is cut until it does. Regions that chance would
    draw (fewer pixels than `log10(tests) / log10(tolerance / π)`) are left out."""
    h, w = image.shape
    if h < 3 or w < 3:
        return np.zeros((0, 4))
    threshold = quantisation / np.sin(tolerance)
    lines = _level_lines(image, threshold)
    tests = 2.5 * (np.log10(w) + np.log10(h)) + np.log10(11.0)
    least = int(-tests / np.log10(tolerance / np.pi))
    region, rectangle, cosine = np.empty((h * w, 2), np.int32), np.empty(6), np.cos(tolerance)
    out, n = np.empty((h * w // max(least, 1) + 1, 4)), 0
    for seed in _by_strength(lines.magnitude, threshold, region.ravel()):
        if np.isnan(lines.free[2 * seed]):
            continue
        size, x, y = _grow(region, np.int64(seed), w, cosine, lines.free)
        if size < least:
            continue
        _fit_rectangle(region[:size], w, x, y, lines.magnitude, rectangle)
        if rectangle[5] < density:
            size = _refine(region, size, w, x, y, density, lines, rectangle)
        if size >= 2 and rectangle[5] >= density:
            for k in range(4):
                out[n, k] = rectangle[k] + 0.5  # a gradient of 2 × 2 pixels lies between them
            n += 1
    return out[:n].copy()


@kernel
def _level_lines(image: U8, threshold: float) -> LevelLines:
    """Level lines of the gradients over 2 × 2 pixels; the image's border is not free."""
    h, w = image.shape
    free, magnitude = np.full(2 * h * w, np.nan, np.float32), np.zeros(h * w, np.float32)
    limit, none = np.float32(threshold), np.float32(np.nan)
    for r in range(1, h - 1):
        a, b, c, d = image[r, 1 : w - 1], image[r, 2:], image[r + 1, 1 : w - 1], image[r + 1, 2:]
        first, end = r * w + 1, r * w + w - 1
        lines, ms = free[2 * first : 2 * end], magnitude[first:end]
        for i in range(w - 2):
            x, y, ms[i] = _level_line(a[i], b[i], c[i], d[i])
            lines[2 * i], lines[2 * i + 1] = x if ms[i] > limit else none, y if ms[i] > limit else none
    return LevelLines(image, free, magnitude)


@kernel
def _level_line(a: int, b: int, c: int, d: int) -> tuple[float, float, float]:
    """Unit vector and magnitude of the gradient over two rows of two grey levels each."""
    falling, rising = np.int32(d) - np.int32(a), np.int32(b) - np.int32(c)
    gx, gy = np.float32(0.5) * np.float32(falling + rising), np.float32(0.5) * np.float32(falling - rising)
    m = np.sqrt(gx * gx + gy * gy)
    inverse = np.float32(1.0) / max(m, np.float32(1e-6))
    return -gy * inverse, gx * inverse, m


@kernel
def _by_strength(magnitude: F32, threshold: float, strong: I32) -> I32:
    """Pixels whose gradient is above a threshold, from the largest to the smallest, in classes of about equal magnitude. `strong` is overwritten."""
    limit, scale = np.float32(threshold), (BINS - 1) / max(magnitude.max(), np.float32(1e-6))
    n = 0
    for i in range(len(magnitude)):
        strong[n] = i
        n += magnitude[i] > limit
    order, start = np.empty(n, np.int32), np.zeros(BINS + 1, np.int32)
    for j in range(n):
        start[BINS - int(magnitude[strong[j]] * scale)] += 1
    for k in range(BINS):
        start[k + 1] += start[k]
    for j in range(n):
        k = BINS - 1 - int(magnitude[strong[j]] * scale)
        order[start[k]] = strong[j]
        start[k] += 1
    return order


@kernel
def _grow(region: I32, seed: int, w: int, cosine: float, free: F32) -> tuple[int, float, float]:
    """Takes the free pixels connected to a seed whose level lines are within an angle of the region's mean; (number, x, y along the mean)."""
    region[0, 0], region[0, 1], size, done = seed % w, seed // w, 1, 0
    x, y = free[2 * seed], free[2 * seed + 1]
    free[2 * seed] = np.nan
    limit = np.float32(cosine)  # times the length of the sum (x, y)
    while done < size:
        column, row = region[done, 0], region[done, 1]
        done += 1
        for r in range(row - 1, row + 2):
            q = np.uint64(2 * (r * w + column - 1))
            for c in range(column - 1, column + 2):
                a, b = free[q], free[q + np.uint64(1)]
                if x * a + y * b >= limit:  # not of NaN
                    free[q] = np.nan
                    region[size, 0], region[size, 1] = c, r
                    size += 1
                    x += a
                    y += b
                    limit = np.float32(cosine) * np.sqrt(x * x + y * y)
                q += np.uint64(2)
    return size, x, y


@kernel
def _fit_rectangle(region: I32, w: int, x: float, y: float, magnitude: F32, out: F64) -> None:
    """Rectangle of a region about its weighted principal axis, directed like (x, y): end points (4), width, share of it that is filled."""
    total, cx, cy = 0.0, 0.0, 0.0
    for k in range(len(region)):
        m = magnitude[region[k, 1] * w + region[k, 0]]
        total += m
        cx += m * region[k, 0]
        cy += m * region[k, 1]
    cx, cy = cx / total, cy / total
    xx, xy, yy = 0.0, 0.0, 0.0
    for k in range(len(region)):
        m, dx, dy = magnitude[region[k, 1] * w + region[k, 0]], region[k, 0] - cx, region[k, 1] - cy
        xx += m * dx * dx
        xy += m * dx * dy
        yy += m * dy * dy
    turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    ux, uy = np.cos(turn), np.sin(turn)
    if ux * x + uy * y < 0.0:
        ux, uy = -ux, -uy
    first, last, left, right = 0.0, 0.0, 0.0, 0.0
    for k in range(len(region)):
        dx, dy = region[k, 0] - cx, region[k, 1] - cy
        along, across = dx * ux + dy * uy, dy * ux - dx * uy
        first, last = min(first, along), max(last, along)
        left, right = min(left, across), max(right, across)
    out[0], out[1], out[2], out[3] = cx + first * ux, cy + first * uy, cx + last * ux, cy + last * uy
    out[4] = max(right - left, 1.0)
    out[5] = len(region) / (max(last - first, 1.0) * out[4])


@kernel
def _refine(region: I32, size: int, w: int, x: float, y: float, density: float, lines: LevelLines, rectangle: F64) -> int:
    """Grows a sparse region anew with the tolerance that the level lines about its seed show, then cuts it shorter until it fills its rectangle."""
    sx, sy, turn, square, near = region[0, 0], region[0, 1], 0.0, 0.0, 0
    seed_x, seed_y = _release(lines, sx, sy)
    for k in range(size):
        x, y = _release(lines, region[k, 0], region[k, 1])
        if (region[k, 0] - sx) ** 2 + (region[k, 1] - sy) ** 2 < rectangle[4] ** 2:
            angle = np.arctan2(seed_x * y - seed_y * x, seed_x * x + seed_y * y)
            turn += angle
            square += angle * angle
            near += 1
    mean = turn / near
    spread = np.sqrt(max(square / near - mean * mean, 0.0))
    size, x, y = _grow(region, sy * w + sx, w, np.cos(min(2.0 * spread, 0.5 * np.pi)), lines.free)
    if size < 2:
        return size
    _fit_rectangle(region[:size], w, x, y, lines.magnitude, rectangle)
    reach = max(np.hypot(rectangle[0] - sx, rectangle[1] - sy), np.hypot(rectangle[2] - sx, rectangle[3] - sy))
    while rectangle[5] < density and size >= 2:
        reach *= 0.75
        kept = 0
        for k in range(size):
            if (region[k, 0] - sx) ** 2 + (region[k, 1] - sy) ** 2 <= reach * reach:
                region[kept, 0], region[kept, 1] = region[k, 0], region[k, 1]
                kept += 1
            else:
                _release(lines, region[k, 0], region[k, 1])
        size = kept
        if size >= 2:
            _fit_rectangle(region[:size], w, x, y, lines.magnitude, rectangle)
    return size


@kernel
def _release(lines: LevelLines, c: int, r: int) -> tuple[float, float]:
    """Makes a pixel free to be taken again; its level line."""
    image = lines.image
    x, y, _ = _level_line(image[r, c], image[r, c + 1], image[r + 1, c], image[r + 1, c + 1])
    place = 2 * (r * image.shape[1] + c)
    lines.free[place], lines.free[place + 1] = x, y
    return x, y
