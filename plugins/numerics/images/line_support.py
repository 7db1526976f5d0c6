"""Straight line segments as regions of pixels whose level lines run alike (von Gioi et al., PAMI 2010; IPOL 2012)."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, U8

BINS = 1024  # of gradient magnitude, by which pixels are taken in order


class LevelLines(NamedTuple):
    """Flat over an image (h · w,): unit vectors along the level lines (dark on the right), gradient magnitudes, and 1 where a pixel may be taken."""

    x: F32
    y: F32
    magnitude: F32
    free: U8


@numba.njit(cache=True, nogil=True, error_model="numpy")
def line_support_segments(image: U8, tolerance: float, quantisation: float, density: float) -> F64:
    """(n, 4) end points (x, y, x, y) of the segments of an image (h, w), pixel centres at integers, strongest seed first.

    `tolerance`, rad, is between the level line of a pixel and the mean of its region; gradients that `quantisation` grey levels could turn by more do
    not count; `density` is the least share of a region's rectangle that it must fill: a bent region is cut until it does. Regions that chance would
    draw (fewer pixels than `log10(tests) / log10(tolerance / π)`) are left out."""
    h, w = image.shape
    if h < 3 or w < 3:
        return np.zeros((0, 4))
    lines = _level_lines(image, quantisation / np.sin(tolerance))
    tests = 2.5 * (np.log10(w) + np.log10(h)) + np.log10(11.0)
    least = int(-tests / np.log10(tolerance / np.pi))
    region, rectangle = np.empty((h * w, 2), np.int32), np.empty(6)
    out, n = np.empty((h * w // max(least, 1) + 1, 4)), 0
    for seed in _by_strength(lines):
        if not lines.free[seed]:
            continue
        size, x, y = _grow(region, seed, w, np.cos(tolerance), lines)
        if size < least:
            continue
        _fit_rectangle(region[:size], w, x, y, lines.magnitude, rectangle)
        if rectangle[5] < density:
            size = _refine(region, size, w, x, y, density, lines, rectangle)
        if size >= 2 and rectangle[5] >= density:
            out[n] = rectangle[:4] + 0.5  # a gradient of 2 × 2 pixels lies between them
            n += 1
    return out[:n].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _level_lines(image: U8, threshold: float) -> LevelLines:
    """Of the gradients over 2 × 2 pixels; the image's border is not free."""
    h, w = image.shape
    x, y, magnitude = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32), np.zeros((h, w), np.float32)
    free = np.zeros((h, w), np.uint8)
    limit, tiny = np.float32(threshold), np.float32(1e-6)
    for r in range(1, h - 1):
        a, b, c, d = image[r, 1 : w - 1], image[r, 2:], image[r + 1, 1 : w - 1], image[r + 1, 2:]
        xs, ys, ms, fs = x[r, 1 : w - 1], y[r, 1 : w - 1], magnitude[r, 1 : w - 1], free[r, 1 : w - 1]
        for i in range(w - 2):
            falling, rising = np.int32(d[i]) - np.int32(a[i]), np.int32(b[i]) - np.int32(c[i])
            gx, gy = np.float32(0.5) * np.float32(falling + rising), np.float32(0.5) * np.float32(falling - rising)
            m = np.sqrt(gx * gx + gy * gy)
            inverse = np.float32(1.0) / max(m, tiny)
            xs[i], ys[i], ms[i] = -gy * inverse, gx * inverse, m
            fs[i] = m > limit
    return LevelLines(x.ravel(), y.ravel(), magnitude.ravel(), free.ravel())


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _by_strength(lines: LevelLines) -> I32:
    """Free pixels from the largest gradient to the smallest, in classes of about equal magnitude."""
    magnitude, free = lines.magnitude, lines.free
    scale = (BINS - 1) / max(magnitude.max(), np.float32(1e-6))
    start = np.zeros(BINS + 1, np.int32)
    for i in range(len(free)):
        if free[i]:
            start[BINS - int(magnitude[i] * scale)] += 1
    for k in range(BINS):
        start[k + 1] += start[k]
    order = np.empty(start[BINS], np.int32)
    for i in range(len(free)):
        if free[i]:
            k = BINS - 1 - int(magnitude[i] * scale)
            order[start[k]] = i
            start[k] += 1
    return order


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _grow(region: I32, seed: int, w: int, cosine: float, lines: LevelLines) -> tuple[int, float, float]:
    """Takes the pixels connected to a seed whose level lines are within an angle of the region's mean; (number, unit vector x, y of the mean)."""
    xs, ys, free = lines.x, lines.y, lines.free
    region[0, 0], region[0, 1], size, done = seed % w, seed // w, 1, 0
    free[seed] = 0
    x, y = xs[seed], ys[seed]
    limit = np.float32(cosine)  # times the length of the sum (x, y)
    while done < size:
        column, row = region[done]
        done += 1
        for r in range(row - 1, row + 2):
            for c in range(column - 1, column + 2):
                q = r * w + c
                if free[q] and x * xs[q] + y * ys[q] >= limit:
                    free[q] = 0
                    region[size, 0], region[size, 1] = c, r
                    size += 1
                    x += xs[q]
                    y += ys[q]
                    limit = np.float32(cosine) * np.sqrt(x * x + y * y)
    length = np.sqrt(x * x + y * y)
    return size, x / length, y / length


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _refine(region: I32, size: int, w: int, x: float, y: float, density: float, lines: LevelLines, rectangle: F64) -> int:
    """Grows a sparse region anew with the tolerance that the level lines about its seed show, then cuts it shorter until it fills its rectangle."""
    sx, sy, turn, square, near = region[0, 0], region[0, 1], 0.0, 0.0, 0
    seed = sy * w + sx
    for k in range(size):
        p = region[k, 1] * w + region[k, 0]
        lines.free[p] = 1
        if (region[k, 0] - sx) ** 2 + (region[k, 1] - sy) ** 2 < rectangle[4] ** 2:
            angle = np.arctan2(lines.x[seed] * lines.y[p] - lines.y[seed] * lines.x[p], lines.x[seed] * lines.x[p] + lines.y[seed] * lines.y[p])
            turn += angle
            square += angle * angle
            near += 1
    mean = turn / near
    spread = np.sqrt(max(square / near - mean * mean, 0.0))
    size, x, y = _grow(region, seed, w, np.cos(min(2.0 * spread, 0.5 * np.pi)), lines)
    if size < 2:
        return size
    _fit_rectangle(region[:size], w, x, y, lines.magnitude, rectangle)
    reach = max(np.hypot(rectangle[0] - sx, rectangle[1] - sy), np.hypot(rectangle[2] - sx, rectangle[3] - sy))
    while rectangle[5] < density and size >= 2:
        reach *= 0.75
        kept = 0
        for k in range(size):
            if (region[k, 0] - sx) ** 2 + (region[k, 1] - sy) ** 2 <= reach * reach:
                region[kept] = region[k]
                kept += 1
            else:
                lines.free[region[k, 1] * w + region[k, 0]] = 1
        size = kept
        if size >= 2:
            _fit_rectangle(region[:size], w, x, y, lines.magnitude, rectangle)
    return size
