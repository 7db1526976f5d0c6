"""Kernels of the line band descriptor (LBD; Zhang & Koch, 2013), binary."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, U8

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
    """Write the derivatives at column c, with those on both sides of it."""
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
