"""A persistent table: columns cut into chunks that successive versions share.

A map grows by a few hundred rows a keyframe and changes a few hundred more. Copying it each time, or writing it whole into the recording, would
cost the square of its size; here a new version copies only the chunks it touches, and the recording holds only those. Chunks whose rows are all
dead are given back: in their place stands one chunk of zeros, the same for all, so that rows keep their numbers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from ctypes import addressof, c_char
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
MANY_BYTES = 1 << 15  # to copy as many takes some ten microseconds
CHUNK = 256  # rows; small enough that a touched chunk is cheap to copy, large enough that gathering is


@dataclass(frozen=True)
class Column:
    """Element type, shape of one row and, unless 0, the step: a power of two of which all values are multiples. Digits that nobody can know take as
    much of a recording as those that are known."""

    dtype: str
    shape: tuple[int, ...] = ()
    step: float = 0.0

    @cached_property
    def element(self) -> np.dtype[Any]:
        """Type of one number."""
        return np.dtype(self.dtype)

    @cached_property
    def row_bytes(self) -> int:
        """Of one row."""
        return self.element.itemsize * math.prod(self.shape)

    def rounded(self, values: Array) -> Array:
        """Values to the nearest multiples of the step, of this type."""
        return np.asarray(np.rint(values / self.step) * self.step if self.step else values, self.element)

    def address_of(self, chunk: Array) -> int:
        """Where the rows of a chunk begin. Raises ValueError for one whose rows are not as large as this column's, one after another."""
        if not chunk.flags.c_contiguous or chunk.nbytes != len(chunk) * self.row_bytes:
            raise ValueError(f"the rows of a chunk are not {self.row_bytes} bytes each, one after another")
        address: int = chunk.__array_interface__["data"][0]
        return address


@cache
def _kernels() -> Any:
    """What copies rows; not before it is needed: numba takes 0.2 s, which a command's help need not."""
    from trihedron.pipeline.core import gathering

    return gathering


@dataclass(frozen=True)
class Table:
    """Rows 0..size-1 in named columns; a row's number is its identity and is never given to another."""

    schema: Mapping[str, Column]
    size: int
    chunks: Mapping[str, tuple[Array, ...]]
    _addresses: dict[str, Array] = field(default_factory=dict, repr=False, compare=False)  # of the chunks, once asked for

    @staticmethod
    def empty(schema: Mapping[str, Column]) -> Table:
        """A table without rows."""
        return Table(schema, 0, {name: () for name in schema})

    def __len__(self) -> int:
        return self.size

    def column(self, name: str) -> Array:
        """All rows of one column, (size, *shape); a copy."""
        column = self.schema[name]
        parts = self.chunks[name]
        return np.concatenate(parts) if parts else np.empty((0, *column.shape), column.dtype)

    def rows(self, name: str, ids: Array) -> Array:
        """(n, *shape) rows `ids` of one column; touches only their chunks' memory. Raises IndexError for an id outside 0..size-1."""
        return self.gathered(ids, name)[0]

    def gathered(self, ids: Array, *names: str) -> list[Array]:
        """Rows `ids` of several columns, like `rows` of each."""
        kernels, numbers, found = _kernels(), np.array(ids, np.int32), []  # of one type, so that one kernel does for all
        for name in names:
            column = self.schema[name]
            rows = np.empty((len(numbers), column.row_bytes), np.uint8)
            gather = kernels.gather if rows.nbytes < MANY_BYTES else kernels.gather_many
            outside = gather(self._addresses_of(name), numbers, CHUNK, self.size, rows)
            if outside >= 0:
                raise IndexError(f"row {ids[outside]} of a table of {self.size}")
            found.append(rows.view(column.element).reshape(len(numbers), *column.shape))
        return found

    def row(self, name: str, number: int) -> Any:
        """One row of a column, which cannot be written. Raises IndexError for a number outside 0..size-1."""
        if not 0 <= number < self.size:
            raise IndexError(f"row {number} of a table of {self.size}")
        return self.chunks[name][number // CHUNK][number % CHUNK]

    def addresses(self, name: str, before: Table | None = None, others: Collection[int] = ()) -> Array:
        """Where the chunks of a column lie, (chunks,) int64, for a kernel; the caller holds the table. All but the `others` are known of the version
        before, where that is given."""
        if before is not None and name not in self._addresses and name in before._addresses:
            self._addresses[name] = self._moved(name, before._addresses[name], others)
        return self._addresses_of(name)

    def _moved(self, name: str, known: Array, others: Collection[int]) -> Array:
        """Addresses of the chunks of a column of which these were others."""
        if not others:
            return known
        addresses = np.empty(len(self.chunks[name]), np.int64)
        addresses[: len(known)] = known
        for number in others:
            addresses[number] = self.schema[name].address_of(self.chunks[name][number])
        return addresses

    def _addresses_of(self, name: str) -> Array:
        if name not in self._addresses:
            column = self.schema[name]
            self._addresses[name] = np.array([column.address_of(chunk) for chunk in self.chunks[name]], np.int64)
        return self._addresses[name]

    def updated(self, ids: Array, **columns: Array) -> Table:
        """A version in which rows `ids` (distinct) of the given columns hold new values; other chunks are shared. Raises IndexError for an id outside
        0..size-1."""
        if len(ids) == 0:
            return self
        rows = np.array(ids, np.int32)
        if rows.min() < 0 or rows.max() >= self.size:
            raise IndexError(f"rows {rows.min()} to {rows.max()} of a table of {self.size}")
        touched = np.flatnonzero(np.bincount(rows // CHUNK)).tolist()
        chunks, addresses = dict(self.chunks), dict(self._addresses)
        for name, given in columns.items():
            column, parts, known = self.schema[name], list(chunks[name]), self._addresses_of(name).copy()
            for number in touched:
                parts[number] = part = parts[number].copy()
                known[number] = _address_of(part)
                part.flags.writeable = False  # for all but the kernel, which is given its address
            values = np.ascontiguousarray(column.rounded(given)).reshape(len(rows), *column.shape)
            _kernels().scatter(known, rows, CHUNK, _bytes(values, column.row_bytes))
            chunks[name], addresses[name] = tuple(parts), known
        return Table(self.schema, self.size, chunks, addresses)

    def keeping(self, spans: Array) -> Table:
        """A version that gives back the full chunks in which none of these rows lie, (n, 2) half open."""
        spans, count = spans[spans[:, 0] < spans[:, 1]], -(-self.size // CHUNK)
        begun, ended = (np.bincount(ends // CHUNK + late, minlength=count + 1) for ends, late in ((spans[:, 0], 0), (spans[:, 1] - 1, 1)))
        return self.emptied(np.flatnonzero(np.cumsum(begun - ended)[: self.size // CHUNK] == 0))

    def emptied(self, numbers: Array) -> Table:
        """A version whose full chunks of these numbers hold zeros, and no memory. One given back before is known by its first column."""
        name, column = next(iter(self.schema.items()))
        known, nothing = self.chunks[name], empty_chunk(column)
        fresh = [number for number in numbers.tolist() if known[number] is not nothing]
        if not fresh:
            return self
        chunks = {}
        for name, parts in self.chunks.items():
            left = list(parts)
            for number in fresh:
                left[number] = empty_chunk(self.schema[name])
            chunks[name] = tuple(left)
        return self._changed(self.size, chunks, fresh)

    def is_empty(self, number: int) -> bool:
        """Whether this chunk was given back."""
        return all(parts[number] is empty_chunk(self.schema[name]) for name, parts in self.chunks.items())

    def appended(self, **columns: Array) -> tuple[Table, Array]:
        """A version with more rows, and their ids; every column must be given, all of one length. Raises ValueError otherwise."""
        lengths = {name: len(values) for name, values in columns.items()}
        if set(lengths) != set(self.schema) or len(set(lengths.values())) != 1:
            raise ValueError(f"appended needs equally long columns {sorted(self.schema)}, got {lengths}")
        count = next(iter(lengths.values()))
        rows = {name: self.schema[name].rounded(values).reshape(count, *self.schema[name].shape) for name, values in columns.items()}
        ids = np.arange(self.size, self.size + count, dtype=np.int32)
        return self.extended(self.size + count, ids[:0], **rows), ids

    def extended(self, size: int, empty: Array, **columns: Array) -> Table:
        """A version of `size` rows in which the chunks `empty` hold nothing; the columns, of the schema's types, are the other new rows."""
        without, chunks, numbers = set(empty.tolist()), {}, range(self.size // CHUNK, -(-size // CHUNK))
        held = [number for number in numbers if number not in without]
        counts = [min(size, (number + 1) * CHUNK) - max(self.size, number * CHUNK) for number in held]
        taken = list(zip(held, accumulate(counts, initial=0), accumulate(counts)))
        for name, values in columns.items():
            known, added = self.chunks[name], dict.fromkeys(numbers, empty_chunk(self.schema[name]))
            for number, first, end in taken:
                part = values[first:end]
                added[number] = part = np.concatenate([known[number], part]) if number < len(known) else part.copy()
                part.flags.writeable = False
            chunks[name] = (*known[: numbers.start], *added.values())
        return self._changed(size, chunks, numbers).emptied(empty)

    def _changed(self, size: int, chunks: Mapping[str, tuple[Array, ...]], numbers: Collection[int]) -> Table:
        """A version with other chunks of these numbers, which knows where the others are."""
        table = Table(self.schema, size, chunks)
        for name, known in dict(self._addresses).items():  # a copy: other threads may ask for more of them
            table._addresses[name] = table._moved(name, known, numbers if chunks[name] is not self.chunks[name] else ())
        return table


_EMPTY: dict[tuple[str, tuple[int, ...]], Array] = {}


def empty_chunk(column: Column) -> Array:
    """The one chunk of zeros of all columns of this kind, for whichever thread asks first."""
    key = column.dtype, column.shape
    if key not in _EMPTY:
        zeros = np.zeros((CHUNK, *column.shape), column.dtype)
        zeros.flags.writeable = False
        _EMPTY.setdefault(key, zeros)
    return _EMPTY[key]


def _address_of(chunk: Array) -> int:
    """Of a chunk that can be written; of others it takes longer to say."""
    return addressof(c_char.from_buffer(chunk.data)) if chunk.nbytes else 0


def _bytes(rows: Array, count: int) -> Array:
    """(n, ...) rows as (n, count) bytes that cannot be written: to a kernel a type of its own."""
    view = rows.view(np.uint8).reshape(len(rows), count)
    view.flags.writeable = False
    return view
