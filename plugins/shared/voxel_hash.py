"""Voxel hashing: integer cell (x, y, z) -> number, in the order of first use.

Open addressing in two arrays, for kernels: a library's table cannot be used in one, and numbers cells in another order on every run.
"""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import I32
from trihedron.plugins.shared.voxel_hash_kernels import FREE, I64, copy_cells

MAX_LOAD = 0.5  # share of slots taken, above which a table is made twice as large


def empty_table(slots: int) -> tuple[I64, I32]:
    """Return keys and numbers of a table without cells; `slots` is a power of two."""
    return np.full(slots, FREE, np.int64), np.empty(slots, np.int32)


def reserve(keys: I64, numbers: I32, more: int) -> tuple[I64, I32]:
    """Return the table, or a larger copy with room for `more` cells."""
    taken = int((keys != FREE).sum()) if more else 0
    slots = len(keys)
    while taken + more > MAX_LOAD * slots:
        slots *= 2
    if slots == len(keys):
        return keys, numbers
    larger = empty_table(slots)
    copy_cells(keys, numbers, *larger)
    return larger
