"""Rows out of an array that lies in pieces, by the pieces' addresses.

Joining the pieces first, to index them as one, copies all of their rows; taking rows piece by piece is a call of Python each. Here a row costs some
nanoseconds wherever it lies."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba.extending import intrinsic
from numpy.typing import NDArray

types: Any = numba.types


def _pointer(kind: Any) -> Any:
    """What reads and writes numbers of this type at an address."""

    def pointer(typing: Any, address: Any) -> Any:
        signature = types.CPointer(kind)(types.int64)
        return signature, lambda context, builder, signature, values: builder.inttoptr(values[0], context.get_value_type(signature.return_type))

    return intrinsic(pointer)


bytes_at, words_at = _pointer(types.uint8), _pointer(types.uint32)


@numba.njit(cache=True)
def _gathered(addresses: NDArray[np.int64], rows: NDArray[np.int32], piece: int, count: int, out: NDArray[np.uint8]) -> int:
    n, size = out.shape
    for i in range(n):
        row = rows[i]
        if row < 0 or row >= count:
            return i
        source = numba.carray(bytes_at(addresses[row // piece] + (row % piece) * size), (size,))
        for k in range(size):
            out[i, k] = source[k]
    return -1


@numba.njit(cache=True)  # this and `scatter` keep the interpreter's lock: to hand it over takes longer
def gather(addresses: NDArray[np.int64], rows: NDArray[np.int32], piece: int, count: int, out: NDArray[np.uint8]) -> int:
    """Copy the bytes of `rows` (n,) into `out` (n, bytes of a row), up to the first that is not one of 0..count-1, whose place in `rows` is returned;
    -1 when all are. Every `piece` rows lie at one of the addresses; the caller holds the pieces."""
    return int(_gathered(addresses, rows, piece, count, out))


@numba.njit(cache=True, nogil=True)
def gather_many(addresses: NDArray[np.int64], rows: NDArray[np.int32], piece: int, count: int, out: NDArray[np.uint8]) -> int:
    """As `gather`, while others may run."""
    return int(_gathered(addresses, rows, piece, count, out))


@numba.njit(cache=True)
def scatter(addresses: NDArray[np.int64], rows: NDArray[np.int32], piece: int, values: NDArray[np.uint8]) -> None:
    """Write the bytes of `values` (n, bytes of a row) to `rows` (n,), the other way round; the caller has seen to it that there are such rows."""
    n, size = values.shape
    for i in range(n):
        target = numba.carray(bytes_at(addresses[rows[i] // piece] + (rows[i] % piece) * size), (size,))
        for k in range(size):
            target[k] = values[i, k]
