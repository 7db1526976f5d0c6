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


def _pointer(typing: Any, address: Any) -> Any:
    """The bytes at an address."""
    signature = types.CPointer(types.uint8)(types.int64)
    return signature, lambda context, builder, signature, values: builder.inttoptr(values[0], context.get_value_type(signature.return_type))


_at: Any = intrinsic(_pointer)


@numba.njit(cache=True, nogil=True)
def gather(addresses: NDArray[np.int64], rows: NDArray[np.int32], piece: int, out: NDArray[np.uint8]) -> None:
    """Copy the bytes of `rows` (n,) into `out` (n, bytes of a row). Every `piece` rows lie at one of the addresses; the caller holds the pieces, and
    has seen to it that they have these rows."""
    n, size = out.shape
    for i in range(n):
        row = rows[i]
        source = numba.carray(_at(addresses[row // piece] + (row % piece) * size), (size,))
        for k in range(size):
            out[i, k] = source[k]
