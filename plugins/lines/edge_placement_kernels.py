"""Kernels that place line segments on the grey-level edge to a fraction of a pixel."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, U8

MAX_SAMPLES = 2056  # of a segment; not a power of two, with which all rows would share cache sets


@kernel
def refine_on_edge(image: U8, lines: F64, reach_px: int, step_px: float) -> F32:
    """Move directed segments (n, 4) onto the grey-level edge and direct them with the bright side on the right, (n, 2, 2).

    Across the segment, every `step_px`, the steepest slope of its polarity within `reach_px` is found to a fraction of a pixel (parabola), and a
    line is fitted to these positions, weighted by slope, reweighted against outliers. A segment with fewer than 4 positions stays as it is."""
    out = np.empty((len(lines), 2, 2), np.float32)
    along, across, weight, levels = np.empty(MAX_SAMPLES), np.empty(MAX_SAMPLES), np.empty(MAX_SAMPLES), np.empty((2 * reach_px + 3, MAX_SAMPLES))
    scratch, gradients = np.empty((4, MAX_SAMPLES)), np.empty((2 * reach_px + 1, MAX_SAMPLES))
    for i in range(len(lines)):
        x0, y0, x1, y1 = lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3]
        length = max(np.hypot(x1 - x0, y1 - y0), 1e-6)
        ux, uy = (x1 - x0) / length, (y1 - y0) / length
        nx, ny = -uy, ux  # to the right of the direction (y points down)
        count = min(int(length / step_px) + 1, MAX_SAMPLES)
        for k in range(count):
            t = length * (k + 0.5) / count
            scratch[0, k], scratch[1, k] = x0 + t * ux, y0 + t * uy
        for j in range(len(levels)):
            _sample_grey(image, scratch, (j - reach_px - 1) * nx, (j - reach_px - 1) * ny, levels[j, :count])
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
                curvature = before - 2.0 * strength + after
                shift = 0.5 * (before - after) / curvature if curvature < -1e-9 else 0.0
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
def _sample_grey(image: U8, scratch: F64, right: float, down: float, out: F64) -> None:
    """Interpolate grey levels (n,) bilinearly at an offset (right, down) from the positions in the first two rows of `scratch`, clamped."""
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
    """Compute the gradients across the segment, in the direction of `sign`, from grey levels of two rows more, and the steepest rise (n,) of each
    sample and its row. All samples of a row at once."""
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
