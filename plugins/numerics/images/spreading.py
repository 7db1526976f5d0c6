"""Choosing image features spread over the image."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import I32, Bool


@numba.njit(cache=True, nogil=True, error_model="numpy")
def spread_over_cells(cells: I32, number: int, order: I32, wanted: int) -> Bool:
    """Which of n features to keep, (n,): each of a `number` of cells of the image gives its best in turn until `wanted` are kept.

    `cells` (n,) says where each feature lies; `order` lists the rows from best to worst. The quota per cell is the largest that keeps the total
    within `wanted`, and the best of the rest fill up, so a rich corner cannot take everything and an even image keeps its best."""
    n = len(cells)
    if n <= wanted:
        return np.ones(n, np.bool_)
    keep, rank, count = np.zeros(n, np.bool_), np.zeros(n, np.int32), np.zeros(number, np.int32)  # rank: place within the cell
    for i in order:
        rank[i] = count[cells[i]]
        count[cells[i]] += 1
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
