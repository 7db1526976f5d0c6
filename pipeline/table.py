"""A persistent table: columns cut into chunks that successive versions share.

A map grows by a few hundred rows a keyframe and changes a few hundred more. Copying it each time, or writing it whole into the recording, would
cost the square of its size; here a new version copies only the chunks it touches, and the recording holds only those. Chunks whose rows are all
dead are given back: in their place stands one chunk of zeros, the same for all, so that rows keep their numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
CHUNK = 256  # rows; small enough that a touched chunk is cheap to copy, large enough that gathering is


@dataclass(frozen=True)
class Column:
    """Element type, shape of one row and, unless 0, the step: a power of two of which all values are multiples. Digits that nobody can know take as
    much of a recording as those that are known."""

    dtype: str
    shape: tuple[int, ...] = ()
    step: float = 0.0

    def rounded(self, values: Array) -> Array:
        """Values to the nearest multiples of the step, of this type."""
        return np.asarray(np.rint(values / self.step) * self.step if self.step else values, self.dtype)

    def addresses_of(self, chunks: Sequence[Array]) -> Array:
        """(n,) where the rows of each chunk begin. Raises ValueError for one whose rows are not as large as this column's, one after another."""
        size = np.dtype(self.dtype).itemsize * math.prod(self.shape)
        if not all(chunk.flags.c_contiguous and chunk.nbytes == len(chunk) * size for chunk in chunks):
            raise ValueError(f"the rows of a chunk are not {size} bytes each, one after another")
        return np.array([chunk.__array_interface__["data"][0] for chunk in chunks], np.int64)


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
        if len(ids) == 0:
            return [np.empty((0, *self.schema[name].shape), self.schema[name].dtype) for name in names]
        least, most = int(ids.min()), int(ids.max())
        if least < 0 or most >= self.size:
            raise IndexError(f"row {most if most >= self.size else least} of a table of {self.size}")
        rows = np.array(ids, np.int32)  # of one type, so that one kernel does for all
        return [self._gathered(rows, name) for name in names]

    def _gathered(self, ids: Array, name: str) -> Array:
        from trihedron.pipeline.gathering import gather  # not before: numba takes 0.2 s, which a command's help need not

        column = self.schema[name]
        if name not in self._addresses:
            self._addresses[name] = column.addresses_of(self.chunks[name])
        rows = np.empty((len(ids), *column.shape), column.dtype)
        gather(self._addresses[name], ids, CHUNK, rows.view(np.uint8).reshape(len(ids), -1))
        return rows

    def updated(self, ids: Array, **columns: Array) -> Table:
        """A version in which rows `ids` (distinct) of the given columns hold new values; other chunks are shared."""
        chunks = dict(self.chunks)
        touched = list(_by_chunk(np.asarray(ids)))
        for name, given in columns.items():
            parts, values = list(chunks[name]), self.schema[name].rounded(given)
            for chunk, here, offset in touched:
                part = parts[chunk].copy()
                part[offset] = values[here]
                part.flags.writeable = False
                parts[chunk] = part
            chunks[name] = tuple(parts)
        return self._changed(self.size, chunks, [chunk for chunk, *_ in touched])

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
        for name, values in columns.items():
            parts, taken = list(self.chunks[name]), 0
            for number in numbers:
                known = parts[number : number + 1]  # begun already
                count = 0 if number in without else min(size, (number + 1) * CHUNK) - max(self.size, number * CHUNK)
                part = np.concatenate([*known, values[taken : taken + count]])
                part.flags.writeable = False
                parts[number : number + 1] = [empty_chunk(self.schema[name]) if number in without else part]
                taken += count
            chunks[name] = tuple(parts)
        return self._changed(size, chunks, numbers).emptied(empty)

    def _changed(self, size: int, chunks: Mapping[str, tuple[Array, ...]], numbers: Sequence[int]) -> Table:
        """A version with other chunks of these numbers, which knows where the others are."""
        addresses = dict(self._addresses)
        for name, known in self._addresses.items():
            if chunks[name] is not self.chunks[name]:
                addresses[name] = np.resize(known, len(chunks[name]))
                addresses[name][numbers] = self.schema[name].addresses_of([chunks[name][number] for number in numbers])
        return Table(self.schema, size, chunks, addresses)


_EMPTY: dict[tuple[str, tuple[int, ...]], Array] = {}


def empty_chunk(column: Column) -> Array:
    """The one chunk of zeros of all columns of this kind, for whichever thread asks first."""
    key = column.dtype, column.shape
    if key not in _EMPTY:
        zeros = np.zeros((CHUNK, *column.shape), column.dtype)
        zeros.flags.writeable = False
        _EMPTY.setdefault(key, zeros)
    return _EMPTY[key]


def _by_chunk(ids: Array) -> Iterator[tuple[int, Any, Array]]:
    """For each chunk that holds some of the rows `ids` (n,): its number, which of the ids they are, and their rows in it."""
    number, offset = ids // CHUNK, ids % CHUNK
    ascending = bool((number[1:] >= number[:-1]).all())
    order = None if ascending else np.argsort(number, kind="stable")
    ranked = number if order is None else number[order]
    edges = [0, *(np.flatnonzero(ranked[1:] != ranked[:-1]) + 1).tolist(), len(ids)]
    for first, end in pairwise(edges):
        if end > first:
            here = slice(first, end) if order is None else order[first:end]
            yield int(ranked[first]), here, offset[here]
