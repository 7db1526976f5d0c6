"""A hash table of cubes in space: integer cell (x, y, z) -> number, in the order in which cells are first met.

Open addressing in two arrays, for kernels: no library's table may be used from one, and theirs number cells in another order on every run.
"""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import I32
from trihedron.plugins.shared.voxel_hash_kernels import FREE, I64, copy_kernel

FULLEST = 0.5  # share of slots taken, above which a table is made twice as large


def empty_table(slots: int) -> tuple[I64, I32]:
    """Keys and numbers of a table without cells; `slots` is a power of two."""
    return np.full(slots, FREE, np.int64), np.empty(slots, np.int32)


def roomy(keys: I64, numbers: I32, more: int) -> tuple[I64, I32]:
    """The table, or one large enough to take `more` cells."""
    taken = int((keys != FREE).sum()) if more else 0
    slots = len(keys)
    while taken + more > FULLEST * slots:
        slots *= 2
    if slots == len(keys):
        return keys, numbers
    larger = empty_table(slots)
    copy_kernel(keys, numbers, *larger)
    return larger
