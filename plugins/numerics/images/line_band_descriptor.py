"""Line band descriptors (LBD), binary."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, U8

BANDS = 9
BYTES = 32


def band_pairs() -> U8:
    """(32, 2) pairs of bands that are compared, the nearest pairs first: 32 of the 36."""
    pairs = sorted(((i, j) for i in range(BANDS) for j in range(i + 1, BANDS)), key=lambda p: (p[1] - p[0], p[0]))
    return np.array(pairs[:BYTES], dtype=np.uint8)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def line_band_descriptors(gradient_x: F32, gradient_y: F32, lines: F32, scale: float, band_px: int, step_px: float, pairs: U8) -> U8:
    """(n, 32) binary descriptors of directed segments (n, 2, 2), from image gradients taken at `scale` of the segments' resolution.

    Zhang & Koch (2013): 9 bands of `band_px` rows beside and on the line; each row sums the positive and negative gradients along and across the
    line; each band is the mean and standard deviation of its rows, and its neighbours', weighted by distance; normalised, capped at 0.4, normalised.
    Bits compare two bands' values, 8 for each of 32 pairs. Gradients are read from the nearest pixel every `step_px`."""
    out = np.zeros((len(lines), BYTES), np.uint8)
    height = BANDS * band_px
    rows, centre = np.empty((height, 4)), 0.5 * (height - 1)
    globally = np.exp(-0.5 * ((np.arange(height) - centre) / centre) ** 2)
    locally = np.exp(-0.5 * ((np.arange(3 * band_px) - (1.5 * band_px - 0.5)) / band_px) ** 2)
    for i in range(len(lines)):
        x0, y0 = (lines[i, 0, 0] + 0.5) * scale - 0.5, (lines[i, 0, 1] + 0.5) * scale - 0.5
        x1, y1 = (lines[i, 1, 0] + 0.5) * scale - 0.5, (lines[i, 1, 1] + 0.5) * scale - 0.5
        _row_sums(gradient_x, gradient_y, x0, y0, x1, y1, step_px, globally, rows)
        values = _bands(rows, band_px, locally)
        for p in range(BYTES):
            byte = 0
            for k in range(8):
                byte = byte * 2 + (values[pairs[p, 0], k] > values[pairs[p, 1], k])
            out[i, p] = byte
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _row_sums(gx: F32, gy: F32, x0: float, y0: float, x1: float, y1: float, step_px: float, weights: F64, rows: F64) -> None:
    """Sums along each row parallel to the segment of the gradient's positive and negative parts, across and along it, per sample and
    weighted by the row."""
    h, w = gx.shape
    length = np.hypot(x1 - x0, y1 - y0)
    ux, uy = (x1 - x0) / max(length, 1e-9), (y1 - y0) / max(length, 1e-9)
    count = max(int(length / step_px), 2)
    centre = 0.5 * (len(rows) - 1)
    xs, ys = np.empty(count), np.empty(count)
    for k in range(count):
        t = length * (k + 0.5) / count
        xs[k], ys[k] = x0 + t * ux, y0 + t * uy
    for r in range(len(rows)):
        o = r - centre
        right, down = o * uy, o * ux
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for k in range(count):
            x, y = int(np.rint(xs[k] - right)), int(np.rint(ys[k] + down))
            if (x >= 0) & (x < w) & (y >= 0) & (y < h):
                across, along = gx[y, x] * -uy + gy[y, x] * ux, gx[y, x] * ux + gy[y, x] * uy
                a += max(across, 0.0)
                b += max(-across, 0.0)
                c += max(along, 0.0)
                d += max(-along, 0.0)
        weight = weights[r] / count
        rows[r, 0], rows[r, 1], rows[r, 2], rows[r, 3] = weight * a, weight * b, weight * c, weight * d


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
