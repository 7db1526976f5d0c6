"""Numba kernels of `edge_width.py`."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, U8


@kernel
def edge_widths(gray: U8, stride: int, contrast: int) -> tuple[F64, F64]:
    """Widths (px) of the edges that every `stride`-th row of an image (h, w) crosses, and those of every `stride`-th column: the rise of a monotone
    run, of at least `contrast` grey levels, by its steepest step."""
    h, w = gray.shape
    along_rows, along_columns = np.empty((h // stride + 1) * w), np.empty((w // stride + 1) * h)  # at most one edge a pixel
    rows, columns = 0, 0
    for y in range(stride // 2, h, stride):
        rows = _add_widths(gray[y], contrast, along_rows, rows)
    for x in range(stride // 2, w, stride):
        columns = _add_widths(gray[:, x], contrast, along_columns, columns)
    return along_rows[:rows], along_columns[:columns]


@kernel
def _add_widths(line: U8, contrast: int, out: F64, count: int) -> int:
    """Write the widths of the edges along a line to `out` from `count` on; return their new number."""
    first, steepest, before = 0, 0, 0
    for x in range(1, len(line) + 1):
        step = int(np.int32(line[x]) - np.int32(line[x - 1])) if x < len(line) else 0
        if step * before <= 0:  # a run ends
            rise = abs(int(np.int32(line[x - 1]) - np.int32(line[first])))
            if rise >= contrast:
                out[count] = rise / steepest
                count += 1
            first, steepest = x - 1, 0
        before, steepest = step, max(steepest, abs(step))
    return count
