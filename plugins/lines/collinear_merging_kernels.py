"""Kernels that merge collinear fragments of one edge into line segments."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64
from trihedron.plugins.shared.sorting_kernels import descending


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
