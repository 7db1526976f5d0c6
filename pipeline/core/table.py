"""A table of landmarks: named columns that grow, in versions that share their memory.

A column is one array with room for more rows. A later version writes its new rows behind those of the version before, in the same array, which that
version never reads; a column whose rows change is copied. A version is never written to.
"""

from __future__ import annotations

import math
import mmap
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.described import Described

Array = NDArray[Any]
CHUNK = 256  # rows whose memory is freed together
GROWTH = 1.5
LARGE = 1 << 20  # bytes of a column whose pages always come from the system
PAGED = 32_768  # bytes of a column from which on its pages come from the system


@dataclass(frozen=True)
class Column:
    """Element type, shape of one row and, unless 0, the step: a power of two of which all values are multiples. Digits below the measurement noise
    would take as much of a recording as the others."""

    dtype: str
    shape: tuple[int, ...] = ()
    step: float = 0.0

    @cached_property
    def element(self) -> np.dtype[Any]:
        """Type of one number."""
        return np.dtype(self.dtype)

    @cached_property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return self.element.itemsize * math.prod(self.shape)

    def rounded(self, values: Array) -> Array:
        """Round values to the nearest multiples of the step, in this type."""
        return np.asarray(np.rint(values / self.step) * self.step if self.step else values, self.element)


def _zeros(shape: tuple[int, ...], element: np.dtype[Any]) -> Array:
    """Make an array of zeros whose pages take memory when they are written to. `np.zeros` does so for large arrays alone: smaller ones reuse memory
    that the process returned, which is there already and has to be cleared."""
    size = element.itemsize * math.prod(shape)
    return np.zeros(shape, element) if size < PAGED else np.frombuffer(mmap.mmap(-1, size, access=mmap.ACCESS_COPY), element).reshape(shape)


class _Buffer:
    """The memory of a column: `used` of its rows belong to a version."""

    def __init__(self, rows: Array, used: int) -> None:
        self.rows, self.used = rows, used


@dataclass(frozen=True)
class Table(Described):
    """Rows 0..size-1 in named columns; a row's number is its identity and is never given to another.

    `freed` are the numbers of the chunks of `CHUNK` rows that were freed: their rows are zero."""

    schema: Mapping[str, Column]
    size: int
    freed: frozenset[int] = frozenset()
    _buffers: Mapping[str, _Buffer] = field(default_factory=dict, repr=False, compare=False)

    @staticmethod
    def empty(schema: Mapping[str, Column]) -> Table:
        """Make a table without rows."""
        return Table(schema, 0, frozenset(), {name: _Buffer(np.empty((0, *column.shape), column.element), 0) for name, column in schema.items()})

    @staticmethod
    def of_columns(schema: Mapping[str, Column], size: int, columns: Mapping[str, Array], freed: frozenset[int]) -> Table:
        """Take (size, *shape) arrays as columns; the caller must not write to them again."""
        return Table(schema, size, freed, {name: _Buffer(columns[name], size) for name in schema})

    def __len__(self) -> int:
        return self.size

    @property
    def nbytes(self) -> int:
        """Bytes of the rows that are not freed."""
        return (self.size - len(self.freed) * CHUNK) * sum(column.row_bytes for column in self.schema.values())

    def shared(self, name: str) -> Array:
        """All rows of one column, (size, *shape); read-only, not a copy."""
        rows = self._buffers[name].rows[: self.size]
        rows.flags.writeable = False
        return rows

    def column(self, name: str) -> Array:
        """Copy all rows of one column, (size, *shape)."""
        return self._buffers[name].rows[: self.size].copy()

    def rows(self, name: str, ids: Array) -> Array:
        """Copy rows `ids` of one column, (n, *shape). Raises IndexError for an id outside 0..size-1."""
        return self.columns_at(ids, name)[0]

    def columns_at(self, ids: Array, *names: str) -> list[Array]:
        """Copy rows `ids` of several columns, like `rows` of each."""
        numbers = self._check_ids(ids)
        return [self._buffers[name].rows.take(numbers, axis=0) for name in names]

    def row(self, name: str, number: int) -> Any:
        """One row of a column, read-only. Raises IndexError for a number outside 0..size-1."""
        if not 0 <= number < self.size:
            raise IndexError(f"row {number} of a table of {self.size}")
        return self.shared(name)[number]

    def same_memory(self, name: str, other: Table) -> bool:
        """Return whether a column shares its memory with another version: then the rows that both have are equal."""
        return name in other._buffers and self._buffers[name] is other._buffers[name]

    def updated(self, ids: Array, **columns: Array) -> Table:
        """Make a version in which rows `ids` (distinct) of the given columns hold new values. Raises IndexError for an id outside 0..size-1."""
        if len(ids) == 0:
            return self
        numbers, buffers = self._check_ids(ids), dict(self._buffers)
        for name, given in columns.items():
            column = self.schema[name]
            buffers[name] = changed = self._copy(name, len(buffers[name].rows), self.freed)
            changed.rows[numbers] = column.rounded(given).reshape(len(numbers), *column.shape)
        written = (numbers // CHUNK).tolist() if self.freed else []
        return Table(self.schema, self.size, self.freed if self.freed.isdisjoint(written) else self.freed.difference(written), buffers)

    def appended(self, **columns: Array) -> tuple[Table, Array]:
        """Make a version with more rows; returns it and their ids. Every column must be given, all of one length. Raises ValueError otherwise."""
        lengths = {name: len(values) for name, values in columns.items()}
        if set(lengths) != set(self.schema) or len(set(lengths.values())) != 1:
            raise ValueError(f"appended needs equally long columns {sorted(self.schema)}, got {lengths}")
        count = next(iter(lengths.values()))
        size, buffers = self.size + count, dict(self._buffers)
        for name, given in columns.items():
            column, buffer = self.schema[name], buffers[name]
            if buffer.used != self.size or len(buffer.rows) < size:  # another version has grown from this one, or there is no room
                buffers[name] = buffer = self._copy(name, max(CHUNK, int(GROWTH * size)), self.freed)
            buffer.rows[self.size : size] = column.rounded(given).reshape(count, *column.shape)
            buffer.used = size
        return Table(self.schema, size, self.freed, buffers), np.arange(self.size, size, dtype=np.int32)

    def keeping(self, spans: Array) -> Table:
        """Make a version that frees the full chunks in which none of these rows lie, (n, 2) half open."""
        spans, count = spans[spans[:, 0] < spans[:, 1]], -(-self.size // CHUNK)
        begun, ended = (np.bincount(ends // CHUNK + late, minlength=count + 1) for ends, late in ((spans[:, 0], 0), (spans[:, 1] - 1, 1)))
        return self.emptied(np.flatnonzero(np.cumsum(begun - ended)[: self.size // CHUNK] == 0))

    def emptied(self, numbers: Array) -> Table:
        """Make a version in which the rows of these full chunks are zero, and take no memory."""
        freed = self.freed.union(numbers.tolist())
        if freed == self.freed:
            return self
        return Table(self.schema, self.size, freed, {name: self._copy(name, len(buffer.rows), freed) for name, buffer in self._buffers.items()})

    def is_empty(self, number: int) -> bool:
        """Return whether this chunk was freed."""
        return number in self.freed

    def _copy(self, name: str, capacity: int, freed: frozenset[int]) -> _Buffer:
        """Copy a column into memory of its own, but for the chunks that are freed. Where there are such they take no memory: zeros that nobody wrote.
        A column without is copied into memory that the process returned, since pages of the system cost more than the copy; not a large one, which
        would leave holes."""
        column, known = self.schema[name], self._buffers[name].rows
        shape = capacity, *column.shape
        rows = _zeros(shape, column.element) if freed or capacity * column.row_bytes > LARGE else np.empty(shape, column.element)
        live = np.zeros(-(-self.size // CHUNK) + 2, np.bool_)  # one more before and behind
        live[1:-1] = True
        live[1 + np.fromiter(freed, np.intp, len(freed))] = False
        for first, end in CHUNK * np.flatnonzero(live[1:] != live[:-1]).reshape(-1, 2):
            rows[first : min(end, self.size)] = known[first : min(end, self.size)]
        return _Buffer(rows, self.size)

    def _check_ids(self, ids: Array) -> Array:
        """Row numbers, after a check. Raises IndexError for one outside 0..size-1."""
        numbers = np.asarray(ids, np.intp)
        if numbers.size and numbers.view(np.uintp).max() >= self.size:  # a negative number is a huge one without its sign
            outside = numbers[(numbers < 0) | (numbers >= self.size)][0]
            raise IndexError(f"row {outside} of a table of {self.size}")
        return numbers
