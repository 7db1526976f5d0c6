"""A hash table of cubes in space: integer cell (x, y, z) -> number, in the order in which cells are first met.

Open addressing in two arrays, for kernels: no library's table may be used from one, and theirs number cells in another order on every run.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import I32

I64 = NDArray[np.int64]
BITS, HALF = 21, 1 << 20  # of a coordinate, that may be -HALF … HALF - 1
FREE = -1
FULLEST = 0.5  # share of slots taken, above which a table is made twice as large


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def key_of(x: int, y: int, z: int) -> int:
    """The cell as one number, at least 0."""
    return ((x + HALF) << (2 * BITS)) | ((y + HALF) << BITS) | (z + HALF)


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def slot_of(keys: I64, key: int) -> int:
    """The slot that holds the key, or the free one where it belongs. There must be a free one."""
    mask = len(keys) - 1
    mixed = (key ^ (key >> 31)) * 0x9E3779B97F4A7C1
    slot = ((mixed ^ (mixed >> 29)) & 0x7FFFFFFFFFFFFFFF) & mask
    while keys[slot] != FREE and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@numba.njit(cache=True, nogil=True, error_model="numpy")
def number_of(keys: I64, numbers: I32, x: int, y: int, z: int) -> int:
    """The cell's number, -1 when it is not in the table."""
    slot = slot_of(keys, key_of(x, y, z))
    return numbers[slot] if keys[slot] != FREE else -1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def absent(keys: I64, cells: I32) -> I32:
    """The rows of the cells (n, 3) that are not in the table."""
    rows, count = np.empty(len(cells), np.int32), 0
    for i in range(len(cells)):
        if keys[slot_of(keys, key_of(cells[i, 0], cells[i, 1], cells[i, 2]))] == FREE:
            rows[count] = i
            count += 1
    return rows[:count].copy()


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
    _copy(keys, numbers, *larger)
    return larger


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _copy(keys: I64, numbers: I32, to_keys: I64, to_numbers: I32) -> None:
    for i in range(len(keys)):
        if keys[i] != FREE:
            slot = slot_of(to_keys, keys[i])
            to_keys[slot], to_numbers[slot] = keys[i], numbers[i]
