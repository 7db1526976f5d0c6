"""Voxel hashing: integer cell (x, y, z) -> number, in the order of first use.

Open addressing in two arrays, for kernels: a library's table cannot be used in one, and numbers cells in another order on every run.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import I32

I64 = NDArray[np.int64]
BITS, HALF = 21, 1 << 20  # of a coordinate, that may be -HALF … HALF - 1
FREE = -1
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


@kernel(inline="always")
def key_of(x: int, y: int, z: int) -> int:
    """Return the key of a cell, a number at least 0."""
    return ((x + HALF) << (2 * BITS)) | ((y + HALF) << BITS) | (z + HALF)


@kernel(inline="always")
def slot_of(keys: I64, key: int) -> int:
    """Find the slot that holds the key, or the free one where it belongs. There must be a free one."""
    mask = len(keys) - 1
    mixed = (key ^ (key >> 31)) * 0x9E3779B97F4A7C1
    slot = ((mixed ^ (mixed >> 29)) & 0x7FFFFFFFFFFFFFFF) & mask
    while keys[slot] != FREE and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@kernel
def number_of(keys: I64, numbers: I32, x: int, y: int, z: int) -> int:
    """Return the cell's number, -1 when it is not in the table."""
    slot = slot_of(keys, key_of(x, y, z))
    return numbers[slot] if keys[slot] != FREE else -1


@kernel
def absent(keys: I64, cells: I32) -> I32:
    """Return the rows of the cells (n, 3) that are not in the table."""
    rows, count = np.empty(len(cells), np.int32), 0
    for i in range(len(cells)):
        if keys[slot_of(keys, key_of(cells[i, 0], cells[i, 1], cells[i, 2]))] == FREE:
            rows[count] = i
            count += 1
    return rows[:count].copy()


@kernel
def copy_cells(keys: I64, numbers: I32, to_keys: I64, to_numbers: I32) -> None:
    """Insert the cells of a table into a larger one."""
    for i in range(len(keys)):
        if keys[i] != FREE:
            slot = slot_of(to_keys, keys[i])
            to_keys[slot], to_numbers[slot] = keys[i], numbers[i]
