"""Choosing image features spread over the image."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, I32, Bool


@numba.njit(cache=True, nogil=True, error_model="numpy")
def spread_over_grid(pixels: F32, order: I32, width: int, height: int, cell_px: int, wanted: int) -> Bool:
    """Which of n features to keep, (n,): each grid cell gives its best in turn until `wanted` are kept.

    `pixels` (n, 2); `order` lists the rows from best to worst. The quota per cell is the largest that keeps the total within `wanted`,
    and the best of the rest fill up, so a rich corner cannot take everything and an even image keeps its best."""
    n = len(pixels)
    keep = np.zeros(n, np.bool_)
    if n <= wanted:
        keep[:] = True
        return keep
    across, down = (width + cell_px - 1) // cell_px, (height + cell_px - 1) // cell_px
    rank = np.zeros(n, np.int32)  # place within the cell
    count = np.zeros(across * down, np.int32)
    for i in order:
        c = min(max(int(pixels[i, 0]) // cell_px, 0), across - 1)
        r = min(max(int(pixels[i, 1]) // cell_px, 0), down - 1)
        rank[i] = count[r * across + c]
        count[r * across + c] += 1
    quota, total = 0, 0
    while True:
        more = 0
        for k in count:
            more += k > quota
        if total + more > wanted:
            break
        total += more
        quota += 1
    left = wanted - total
    for i in order:
        if rank[i] < quota:
            keep[i] = True
        elif rank[i] == quota and left > 0:
            keep[i] = True
            left -= 1
    return keep
