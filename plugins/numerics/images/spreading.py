"""Choosing image features spread over the image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, I32, Bool


@dataclass(frozen=True)
class Grid:
    """Square cells over an image, numbered row by row."""

    cell_px: int
    down: int
    across: int

    def places(self, pixels: I32, ratio: F64) -> I32:
        """(n,) cell of each pixel (n, 2) of an image `ratio` times smaller (x, y)."""
        cells = (pixels * (ratio / self.cell_px)).astype(np.int32)
        return np.minimum(cells[:, 1], self.down - 1) * self.across + np.minimum(cells[:, 0], self.across - 1)

    def groups(self, marked: Bool) -> tuple[I32, list[tuple[int, int, int, int]]]:
        """Neighbouring marked cells (n,) as groups: the number of each cell's group, 0 = none (n,), and rectangles (left, top, right, bottom) in px
        around group 1, 2, …, half open."""
        _, numbers, stats, _ = cv2.connectedComponentsWithStats(marked.reshape(self.down, self.across).astype(np.uint8))
        side = self.cell_px
        return numbers.ravel(), [(x * side, y * side, (x + w) * side, (y + h) * side) for x, y, w, h, _ in stats[1:].tolist()]


@numba.njit(cache=True, nogil=True)
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
