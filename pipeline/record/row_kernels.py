"""Rows compared, taken and turned where they lie, for the recording.

They are few calls that keep the interpreter's lock: NumPy and OpenCV give it away whenever they go through some hundred numbers, and a thread that
writes beside those that track would wait for it, and let them wait, some thirty times a frame."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.gathering import bytes_at, words_at

Ints = NDArray[Any]  # of 32 or 64 bits
Bytes = NDArray[np.uint8]
WORD = 4  # bytes


@numba.njit(cache=True)
def differing(before: Ints, after: Ints, pieces: Ints, piece: int, known: int, size: int, row_bytes: int, found: Ints) -> int:
    """Write the numbers of the rows that are not as before into `found`, and return how many they are.

    Every `piece` rows lie at one of the addresses `before` and `after`; only those of the numbers `pieces` are looked at. There were `known` rows,
    and there are `size`. Rows are compared by their bytes: NaN is no change."""
    words, count = row_bytes // WORD, 0
    for piece_number in pieces:
        first, new = piece_number * piece, after[piece_number]
        old = before[piece_number] if piece_number < len(before) else new
        for i in range(min(piece, size - first)):
            same = first + i < known
            if same:
                k = 0
                a, b = words_at(old + i * row_bytes), words_at(new + i * row_bytes)
                while k < words and a[k] == b[k]:
                    k += 1
                same = k == words
            if same:
                k = words * WORD
                c, d = bytes_at(old + i * row_bytes), bytes_at(new + i * row_bytes)
                while k < row_bytes and c[k] == d[k]:
                    k += 1
                same = k == row_bytes
            if not same:
                found[count] = first + i
                count += 1
    return count


@numba.njit(cache=True)
def take(addresses: Ints, rows: Ints, piece: int, row_bytes: int, turned: bool, out: Bytes) -> None:
    """Copy rows (n,), whose numbers grow, into `out` (n * row_bytes,): row by row or, turned, the first byte of all, then the second. Every `piece`
    rows lie at one of the addresses."""
    count, first, end = len(rows), 0, 0
    address = addresses[0]
    for i in range(count):
        if rows[i] >= end:
            first = rows[i] // piece * piece
            address, end = addresses[first // piece], first + piece
        source = bytes_at(address + (rows[i] - first) * row_bytes)
        if turned:
            for k in range(row_bytes):
                out[k * count + i] = source[k]
        else:
            for k in range(row_bytes):
                out[i * row_bytes + k] = source[k]


@numba.njit(cache=True)
def turn(address: int, count: int, row_bytes: int, out: Bytes) -> None:
    """Write `count` rows, one after another from an address, into `out` (count * row_bytes,) byte by byte: the first of all, then the second."""
    if row_bytes % WORD == 0:
        source, words = words_at(address), row_bytes // WORD
        for w in range(words):
            at = w * WORD * count
            for i in range(count):
                word = source[i * words + w]
                out[at + i] = word & 0xFF
                out[at + count + i] = word >> 8 & 0xFF
                out[at + 2 * count + i] = word >> 16 & 0xFF
                out[at + 3 * count + i] = word >> 24
    else:
        single = bytes_at(address)
        for k in range(row_bytes):
            for i in range(count):
                out[k * count + i] = single[i * row_bytes + k]


def ready() -> None:
    """Load what is here, or compile it: before there is a message that would wait for it, and be lost with the process."""
    addresses, rows, out = np.zeros(1, np.int64), np.empty(0, np.int32), np.empty(0, np.uint8)
    differing(addresses, addresses, rows, 1, 0, 0, 1, rows)
    take(addresses, rows, 1, 1, False, out)
    turn(0, 0, 1, out)
