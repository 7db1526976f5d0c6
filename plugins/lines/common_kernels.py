"""Numba kernels of `common.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, U8
from trihedron.plugins.shared.sorting_kernels import descending

# Image line segments: merging of collinear fragments and sub-pixel placement on the grey-level edge.

MOST = 2056  # samples of a segment; rows of a power of two would all lie in the same part of a cache


class Placing(NamedTuple):
    """Rules for joining and selecting segments: the difference of direction (rad) of fragments of one edge, their distance across and along, the
    shortest segment, how near to the image's border all along a segment is the border, and how far across it its edge is searched, px."""

    angle: float
    offset_px: float
    gap_px: float
    least_px: float
    border_px: float
    reach_px: int


@kernel
def placed_segments(image: U8, found: F64, scale: float, placing: Placing, most: int) -> F32:
    """(n, 2, 2) the longest of the segments (m, 4) `found` on the image at `scale`, joined and placed on the edge of the image; twice, because
    fragments of one edge become collinear when placed."""
    angle, offset_px, gap_px, least_px, border_px, reach_px = placing
    lines, out = np.empty((len(found), 4)), np.empty((0, 2, 2), np.float32)
    for i in range(len(found)):
        for j in range(4):
            lines[i, j] = (found[i, j] + 0.5) / scale - 0.5
    for share in (1.0, 0.5):
        lines = merge_collinear(lines, share * angle, share * offset_px, gap_px)[: 2 * most]
        out = refine_on_edge(image, _worthy(lines, least_px, border_px, image.shape[1], image.shape[0]), reach_px, 2.0)
        lines = out.astype(np.float64).reshape(-1, 4)
    return out[:most].copy()


@kernel
def _worthy(lines: F64, least_px: float, border_px: float, width: int, height: int) -> F64:
    """Select segments that are long enough, and not the border of the image (or of what the sensor's registration left of it)."""
    out, n = np.empty((len(lines), 4)), 0
    right, bottom = width - 1 - border_px, height - 1 - border_px
    for i in range(len(lines)):
        x0, y0, x1, y1 = lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3]
        inside = not (max(x0, x1) < border_px or min(x0, x1) > right or max(y0, y1) < border_px or min(y0, y1) > bottom)
        if inside and np.hypot(x1 - x0, y1 - y0) >= least_px:
            out[n, 0], out[n, 1], out[n, 2], out[n, 3] = x0, y0, x1, y1
            n += 1
    return out[:n]


@kernel
def merge_collinear(lines: F64, angle: float, offset_px: float, gap_px: float) -> F64:
    """Join directed segments (n, 4) of rows (x0, y0, x1, y1) that continue each other: directions within `angle` rad, ends within `offset_px` of the
    longer one's line, at most `gap_px` apart along it. Returns (m, 4), longest first; ties by position, so the order of the input does not matter."""
    n = len(lines)
    length = np.empty(n)
    key = np.empty(n)
    for i in range(n):
        length[i] = np.hypot(lines[i, 2] - lines[i, 0], lines[i, 3] - lines[i, 1])
        key[i] = length[i] - 1e-9 * (lines[i, 0] + 1e-3 * lines[i, 1])
    order = descending(key)
    out, joined = np.empty((n, 4)), np.empty(n)
    used = np.zeros(n, np.bool_)
    m = 0
    least = np.cos(angle)
    for s in range(n):
        i = order[s]
        if used[i] or length[i] < 1e-6:
            continue
        used[i] = True
        ux, uy = (lines[i, 2] - lines[i, 0]) / length[i], (lines[i, 3] - lines[i, 1]) / length[i]
        x, y, low, high = lines[i, 0], lines[i, 1], 0.0, length[i]
        grown = True
        while grown:
            grown = False
            for k in range(s + 1, n):
                j = order[k]
                if used[j] or length[j] < 1e-6:
                    continue
                ax, ay, bx, by = lines[j, 0] - x, lines[j, 1] - y, lines[j, 2] - x, lines[j, 3] - y
                if ((bx - ax) * ux + (by - ay) * uy) < least * length[j]:
                    continue
                if abs(ax * uy - ay * ux) > offset_px or abs(bx * uy - by * ux) > offset_px:
                    continue
                a, b = ax * ux + ay * uy, bx * ux + by * uy
                if a > high + gap_px or b < low - gap_px:
                    continue
                used[j], grown = True, True
                low, high = min(low, a), max(high, b)
        out[m, 0], out[m, 1], out[m, 2], out[m, 3] = x + low * ux, y + low * uy, x + high * ux, y + high * uy
        joined[m] = np.sqrt((out[m, 2] - out[m, 0]) ** 2 + (out[m, 3] - out[m, 1]) ** 2)
        m += 1
    return out[descending(joined[:m])]


@kernel
def refine_on_edge(image: U8, lines: F64, reach_px: int, step_px: float) -> F32:
    """Move directed segments (n, 4) onto the grey-level edge and direct them with the bright side on the right, (n, 2, 2).

    Across the segment, every `step_px`, the steepest slope of its polarity within `reach_px` is found to a fraction of a pixel (parabola), and a
    line is fitted to these positions, weighted by slope, reweighted against outliers. A segment with fewer than 4 positions stays as it is."""
    out = np.empty((len(lines), 2, 2), np.float32)
    along, across, weight, levels = np.empty(MOST), np.empty(MOST), np.empty(MOST), np.empty((2 * reach_px + 3, MOST))
    scratch, gradients = np.empty((4, MOST)), np.empty((2 * reach_px + 1, MOST))
    for i in range(len(lines)):
        x0, y0, x1, y1 = lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3]
        length = max(np.hypot(x1 - x0, y1 - y0), 1e-6)
        ux, uy = (x1 - x0) / length, (y1 - y0) / length
        nx, ny = -uy, ux  # to the right of the direction (y points down)
        count = min(int(length / step_px) + 1, MOST)
        for k in range(count):
            t = length * (k + 0.5) / count
            scratch[0, k], scratch[1, k] = x0 + t * ux, y0 + t * uy
        for j in range(len(levels)):
            _levels_beside(image, scratch, (j - reach_px - 1) * nx, (j - reach_px - 1) * ny, levels[j, :count])
        contrast = 0.0
        for k in range(count):
            contrast += levels[reach_px + 2, k] - levels[reach_px, k]
        sign = 1 if contrast >= 0.0 else -1
        _steepest(levels, sign, gradients, scratch[0, :count], scratch[1, :count])
        m = 0
        for k in range(count):
            strength, row = scratch[0, k], int(scratch[1, k])
            if 0 < row < len(gradients) - 1 and strength > 1.0:  # not at the end of the reach, and a rise
                before, after = gradients[row - 1, k], gradients[row + 1, k]
                bend = before - 2.0 * strength + after
                shift = 0.5 * (before - after) / bend if bend < -1e-9 else 0.0
                along[m], across[m], weight[m] = length * (k + 0.5) / count, (row - reach_px + shift) * sign, strength
                m += 1
        if m >= 4:
            a, b = _robust_line(along[:m], across[:m], weight[:m])
            x0, y0, x1, y1 = x0 + a * nx, y0 + a * ny, x1 + (a + b * length) * nx, y1 + (a + b * length) * ny
        if sign < 0:
            x0, y0, x1, y1 = x1, y1, x0, y0
        out[i, 0, 0], out[i, 0, 1], out[i, 1, 0], out[i, 1, 1] = x0, y0, x1, y1
    return out


@kernel
def _levels_beside(image: U8, scratch: F64, right: float, down: float, out: F64) -> None:
    """Writes grey levels (n,), bilinear, so far from the positions in the first two rows of `scratch`; those outside the image are the border's."""
    rows, cols = image.shape
    flat, xs, ys, place, aside = image.ravel(), scratch[0], scratch[1], scratch[2].view(np.int64), scratch[3]
    for k in range(len(out)):
        x, y = min(max(xs[k] + right, 0.0), cols - 1.001), min(max(ys[k] + down, 0.0), rows - 1.001)
        c, r = int(x), int(y)
        place[k], aside[k], out[k] = r * cols + c, x - c, y - r
    for k in range(len(out)):
        a, b, p = aside[k], out[k], np.uint64(place[k])
        q = p + np.uint64(cols)
        top = flat[p] * (1.0 - a) + flat[p + np.uint64(1)] * a
        out[k] = top * (1.0 - b) + (flat[q] * (1.0 - a) + flat[q + np.uint64(1)] * a) * b


@kernel
def _steepest(levels: F64, sign: int, gradients: F64, top: F64, row: F64) -> None:
    """Compute, from the grey levels across samples (two rows more than `gradients` has): the gradients, counted along `sign`, the steepest rise (n,)
    of each sample and its row. All samples of a row at once."""
    reach, n = len(gradients) // 2, len(top)
    for j in range(len(gradients)):
        here = reach + 1 + sign * (j - reach)
        after, before, slope = levels[here + sign, :n], levels[here - sign, :n], gradients[j, :n]
        for k in range(n):
            slope[k] = 0.5 * (after[k] - before[k])
        for k in range(n):
            more = (slope[k] > top[k]) | (j == 0)
            top[k], row[k] = slope[k] if more else top[k], float(j) if more else row[k]


@kernel
def _robust_line(t: F64, o: F64, strength: F64) -> tuple[float, float]:
    """Offset a and slope b of o ≈ a + b t, by least squares reweighted with w = strength / (1 + (r / ½ px)²), starting from the median offset."""
    a, b = np.median(o), 0.0
    for _ in range(5):
        s, st, so, stt, sto = 1e-12, 0.0, 0.0, 0.0, 0.0
        for k in range(len(t)):
            r = 2.0 * (o[k] - a - b * t[k])
            w = strength[k] / (1.0 + r * r)
            s += w
            st += w * t[k]
            so += w * o[k]
            stt += w * t[k] * t[k]
            sto += w * t[k] * o[k]
        det = s * stt - st * st
        if det < 1e-9:
            break
        b = (s * sto - st * so) / det
        a = (so - b * st) / s
    return a, b


# Line band descriptors (LBD), binary.

BANDS = 9
BYTES = 32


@kernel
def line_band_descriptors(image: U8, lines: F32, scale: float, band_px: int, step_px: float) -> U8:
    """(n, 32) binary descriptors of directed segments (n, 2, 2), from an image (h, w) that is `scale` times the size of the one they were found in.

    Zhang & Koch (2013): 9 bands of `band_px` rows beside and on the line; each row sums the positive and negative gradients along and across the
    line; each band is the mean and standard deviation of its rows, and its neighbours', weighted by distance; normalised, capped at 0.4, normalised.
    Bits compare two bands' values, 8 for each of 32 of the 36 pairs, the nearest first. Gradients are read from the nearest pixel every `step_px`."""
    h, w = image.shape
    gradients, out = _gradients(image), np.zeros((len(lines), BYTES), np.uint8)
    height = BANDS * band_px
    rows, centre, scratch = np.empty((height, 4)), 0.5 * (height - 1), np.empty((8, height))
    globally = np.exp(-0.5 * ((np.arange(height) - centre) / centre) ** 2)
    locally = np.exp(-0.5 * ((np.arange(3 * band_px) - (1.5 * band_px - 0.5)) / band_px) ** 2)
    for i in range(len(lines)):
        x0, y0 = (lines[i, 0, 0] + 0.5) * scale - 0.5, (lines[i, 0, 1] + 0.5) * scale - 0.5
        x1, y1 = (lines[i, 1, 0] + 0.5) * scale - 0.5, (lines[i, 1, 1] + 0.5) * scale - 0.5
        _row_sums(gradients, h, w, x0, y0, x1, y1, step_px, globally, scratch, rows)
        values = _bands(rows, band_px, locally)
        p = 0
        for gap in range(1, BANDS):
            for j in range(min(BANDS - gap, BYTES - p)):
                byte = 0
                for k in range(8):
                    byte = byte * 2 + (values[j, k] > values[j + gap, k])
                out[i, p] = byte
                p += 1
    return out


@kernel
def _gradients(image: U8) -> F32:
    """(h · w + 1, 2) derivatives (Sobel) to the right and down, the image reflected at its borders, and zeros for what lies outside."""
    h, w = image.shape
    out = np.zeros((h * w + 1, 2), np.float32)
    for r in range(h):
        above, here, below = image[min(abs(r - 1), h - 1)], image[r], image[r + 1 if r + 1 < h else max(h - 2, 0)]
        row = out[r * w : r * w + w]
        for c in range(1, w - 1):
            _gradient(above, here, below, c - 1, c, c + 1, row)
        _gradient(above, here, below, min(1, w - 1), 0, min(1, w - 1), row)
        _gradient(above, here, below, max(w - 2, 0), w - 1, max(w - 2, 0), row)
    return out


@kernel
def _gradient(above: U8, here: U8, below: U8, left: int, c: int, right: int, out: F32) -> None:
    """Writes the derivatives at column c, with those on both sides of it."""
    falling, rising = np.int32(below[right]) - np.int32(above[left]), np.int32(above[right]) - np.int32(below[left])
    across, down = np.int32(here[right]) - np.int32(here[left]), np.int32(below[c]) - np.int32(above[c])
    out[c, 0], out[c, 1] = np.int32(falling + rising + 2 * across), np.int32(falling - rising + 2 * down)


@kernel
def _row_sums(
    gradients: F32, h: int, w: int, x0: float, y0: float, x1: float, y1: float, step_px: float, weights: F64, scratch: F64, rows: F64
) -> None:
    """Sums along each row parallel to the segment of the gradient's positive and negative parts, across and along it, per sample and
    weighted by the row. One sample of all rows after another, since rows do not wait for each other: the compiler takes several at once."""
    length = np.hypot(x1 - x0, y1 - y0)
    ux, uy = (x1 - x0) / max(length, 1e-9), (y1 - y0) / max(length, 1e-9)
    count, centre = max(int(length / step_px), 2), 0.5 * (len(rows) - 1)
    place, gx, gy, a, b, c, d = scratch[0].view(np.int64), scratch[1], scratch[2], scratch[3], scratch[4], scratch[5], scratch[6]
    a[:], b[:], c[:], d[:] = 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        t = length * (k + 0.5) / count
        middle_x, middle_y = x0 + t * ux, y0 + t * uy
        for r in range(len(place)):
            o = r - centre
            x, y = int(np.rint(middle_x - o * uy)), int(np.rint(middle_y + o * ux))
            place[r] = y * w + x if (x >= 0) & (x < w) & (y >= 0) & (y < h) else h * w
        for r in range(len(place)):
            p = np.uint64(place[r])
            gx[r], gy[r] = gradients[p, np.uint64(0)], gradients[p, np.uint64(1)]
        for r in range(len(place)):
            across, along = gx[r] * -uy + gy[r] * ux, gx[r] * ux + gy[r] * uy
            a[r] += max(across, 0.0)
            b[r] += max(-across, 0.0)
            c[r] += max(along, 0.0)
            d[r] += max(-along, 0.0)
    for r in range(len(place)):
        weight = weights[r] / count
        rows[r, 0], rows[r, 1], rows[r, 2], rows[r, 3] = weight * a[r], weight * b[r], weight * c[r], weight * d[r]


@kernel
def _bands(rows: F64, band_px: int, weights: F64) -> F64:
    """(9, 8): mean and standard deviation of the row sums of each band and its neighbours, weighted (3 · band_px,); both parts normalised over the
    line."""
    values = np.zeros((BANDS, 8))
    for b in range(BANDS):
        first = (b - 1) * band_px
        low, high = max(first, 0), min(first + 3 * band_px, len(rows))
        for k in range(4):
            s, m, q = 0.0, 0.0, 0.0
            for r in range(low, high):
                w = weights[r - first]
                s += 1.0
                m += w * rows[r, k]
                q += w * rows[r, k] * w * rows[r, k]
            values[b, k] = m / s
            values[b, 4 + k] = np.sqrt(max(q / s - (m / s) ** 2, 0.0))
    for part in range(0, 8, 4):
        for turn in range(2):
            norm = 0.0
            for b in range(BANDS):
                for k in range(part, part + 4):
                    norm += values[b, k] * values[b, k]
            norm = 1.0 / max(np.sqrt(norm), 1e-12)
            for b in range(BANDS):
                for k in range(part, part + 4):
                    values[b, k] = min(values[b, k] * norm, 0.4 if turn == 0 else 1.0)
    return values
