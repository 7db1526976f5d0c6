"""Image line segments: merging of collinear fragments and sub-pixel placement on the grey-level edge."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, U8


@numba.njit(cache=True, nogil=True, error_model="numpy")
def bilinear(image: U8, x: float, y: float) -> float:
    """Grey level at a sub-pixel position; positions outside take the border's."""
    rows, cols = image.shape
    x, y = min(max(x, 0.0), cols - 1.001), min(max(y, 0.0), rows - 1.001)
    c, r = int(x), int(y)
    a, b = x - c, y - r
    top = image[r, c] * (1.0 - a) + image[r, c + 1] * a
    return top * (1.0 - b) + (image[r + 1, c] * (1.0 - a) + image[r + 1, c + 1] * a) * b


@numba.njit(cache=True, nogil=True, error_model="numpy")
def merge_collinear(lines: F64, angle: float, offset_px: float, gap_px: float) -> F64:
    """Join directed segments (n, 4) of rows (x0, y0, x1, y1) that continue each other: directions within `angle` rad, ends within `offset_px` of the
    longer one's line, at most `gap_px` apart along it. Returns (m, 4), longest first; ties by position, so the order of the input does not matter."""
    n = len(lines)
    length = np.empty(n)
    key = np.empty(n)
    for i in range(n):
        length[i] = np.hypot(lines[i, 2] - lines[i, 0], lines[i, 3] - lines[i, 1])
        key[i] = -length[i] + 1e-9 * (lines[i, 0] + 1e-3 * lines[i, 1])
    order = np.argsort(key, kind="mergesort")
    out = np.empty((n, 4))
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
        out[m] = x + low * ux, y + low * uy, x + high * ux, y + high * uy
        m += 1
    final = -np.sqrt((out[:m, 2] - out[:m, 0]) ** 2 + (out[:m, 3] - out[:m, 1]) ** 2)
    return out[:m][np.argsort(final, kind="mergesort")]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def refine_on_edge(image: U8, lines: F64, reach_px: int, step_px: float) -> F32:
    """Move directed segments (n, 4) onto the grey-level edge and direct them with the bright side on the right, (n, 2, 2).

    Across the segment, every `step_px`, the steepest slope of its polarity within `reach_px` is found to a fraction of a pixel (parabola), and a
    line is fitted to these positions, weighted by slope, reweighted against outliers. A segment with fewer than 4 positions stays as it is."""
    out = np.empty((len(lines), 2, 2), np.float32)
    most = 2048
    along, across, weight = np.empty(most), np.empty(most), np.empty(most)
    slope = np.empty(2 * reach_px + 1)
    for i in range(len(lines)):
        x0, y0, x1, y1 = lines[i]
        length = max(np.hypot(x1 - x0, y1 - y0), 1e-6)
        ux, uy = (x1 - x0) / length, (y1 - y0) / length
        nx, ny = -uy, ux  # to the right of the direction (y points down)
        count = min(int(length / step_px) + 1, most)
        contrast = 0.0
        for k in range(count):
            t = length * (k + 0.5) / count
            contrast += bilinear(image, x0 + t * ux + nx, y0 + t * uy + ny) - bilinear(image, x0 + t * ux - nx, y0 + t * uy - ny)
        sign = 1.0 if contrast >= 0.0 else -1.0
        m = 0
        for k in range(count):
            t = length * (k + 0.5) / count
            found, offset, strength = _edge_across(image, x0 + t * ux, y0 + t * uy, nx * sign, ny * sign, slope)
            if found:
                along[m], across[m], weight[m] = t, offset * sign, strength
                m += 1
        if m >= 4:
            a, b = _robust_line(along[:m], across[:m], weight[:m])
            x0, y0, x1, y1 = x0 + a * nx, y0 + a * ny, x1 + (a + b * length) * nx, y1 + (a + b * length) * ny
        if sign < 0.0:
            x0, y0, x1, y1 = x1, y1, x0, y0
        out[i, 0, 0], out[i, 0, 1], out[i, 1, 0], out[i, 1, 1] = x0, y0, x1, y1
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _edge_across(image: U8, x: float, y: float, nx: float, ny: float, slope: F64) -> tuple[bool, float, float]:
    """Offset along (nx, ny) of the steepest rise, and its slope; False when the steepest is at the end of the reach or there is no rise."""
    reach = len(slope) // 2
    before = bilinear(image, x - (reach + 1) * nx, y - (reach + 1) * ny)
    here = bilinear(image, x - reach * nx, y - reach * ny)
    best = 0
    for k in range(len(slope)):
        after = bilinear(image, x + (k + 1 - reach) * nx, y + (k + 1 - reach) * ny)
        slope[k] = 0.5 * (after - before)
        before, here = here, after
        if slope[k] > slope[best]:
            best = k
    if best == 0 or best == len(slope) - 1 or slope[best] <= 1.0:
        return False, 0.0, 0.0
    a, b, c = slope[best - 1], slope[best], slope[best + 1]
    bend = a - 2.0 * b + c
    shift = 0.5 * (a - c) / bend if bend < -1e-9 else 0.0
    return True, best - reach + shift, b


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
