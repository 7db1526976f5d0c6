"""Tables (see `table`) as arrays of a message, and back: the rows that changed since an earlier message of the topic, or all.

A message changes the one before it. Every `CHECKPOINT_EVERY` it changes the last such checkpoint instead, so that one message is read without all
that came before; where that spares little, or after `MAX_CHECKPOINTS`, it is a full snapshot. So what a frame takes does not grow with the map, and
neither does what is read for it.

A table is a message `trihedron.Table`: `layout`, a JSON text with `size`, `back` (how many messages ago the table was that this changes; 0: a full
snapshot), `schema` and, for each column that changed, the number k of its list of rows; and arrays: `rows<k>`, `position_m` with the values of these
rows, and `emptied` with the numbers of the chunks that were freed. Here, and in files until format 4, they are `points#`, `points#rows<k>` and so on.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.table import CHUNK, Column, Table
from trihedron.pipeline.record.array_codec import MAX_BYTES, array_parts, bytes_field, element_type

ROW_NUMBER = 8  # bytes of a row's number, which a row without columns takes, too
CHECKPOINT_EVERY = 64  # messages; on a walk through new rooms a checkpoint adds a third to the changes, however far apart they are
MAX_CHECKPOINTS = 16  # that build on each other: reading one frame reads them all
_LAYOUT, _ARRAYS = 1, 2  # fields of `trihedron.Table`
WORTH = 2 / 3  # of the bytes of a full snapshot, which a checkpoint must not exceed


class TableWriter:
    """Writes the tables of the values of one topic, in order."""

    def __init__(self) -> None:
        self._latest: Mapping[str, Table] = {}
        self._checkpoint: Mapping[str, Table] = {}
        self._back = 0  # messages since the checkpoint
        self._checkpoints = 0  # that build on each other

    def parts(self, tables: Mapping[str, Table]) -> dict[str, list[Any]]:
        """Encode one value's tables: the parts of each one's message."""
        self._back += 1
        known, latest, self._latest = self._checkpoint, self._latest, tables
        if self._back < CHECKPOINT_EVERY and _continues(latest, tables):
            return _parts(tables, latest, 1)
        parts: dict[str, list[Any]] = {}
        if self._checkpoints < MAX_CHECKPOINTS and _continues(known, tables):
            parts = _parts(tables, known, self._back)
        if not parts or sum(map(bytes_of, parts.values())) > WORTH * sum(table.nbytes for table in tables.values()):
            parts, self._checkpoints = _parts(tables, {}, 0), 0
        self._checkpoint, self._back, self._checkpoints = tables, 0, self._checkpoints + 1
        return parts


def _continues(known: Mapping[str, Table], tables: Mapping[str, Table]) -> bool:
    """Return whether these are the known tables, grown."""
    return bool(known) and all(known[name].schema == table.schema and known[name].size <= table.size for name, table in tables.items())


def bytes_of(parts: Sequence[Any]) -> int:
    """Return the bytes of parts of a message."""
    return sum(memoryview(part).nbytes for part in parts)


def _parts(tables: Mapping[str, Table], known: Mapping[str, Table], back: int) -> dict[str, list[Any]]:
    return {name: _table_parts(table, known.get(name), back) for name, table in tables.items()}


def _table_parts(table: Table, previous: Table | None, back: int) -> list[Any]:
    """The rows of each column that `previous` does not have; columns whose rows are the same share the list of their numbers."""
    parts: list[Any] = []
    changed: dict[str, int] = {}
    numbers: dict[bytes, int] = {}
    before = previous if previous is not None else Table.empty(table.schema)
    freed = np.array(sorted(table.freed - before.freed) if table.freed is not before.freed else [], np.int32)
    for column in table.schema:
        ids = _changed_rows(before, table, column, freed)
        if len(ids):
            changed[column] = numbers.setdefault(ids.tobytes(), len(numbers))
            parts += array_parts(_ARRAYS, column, table.shared(column).take(ids, axis=0), named=True)
    for ids_bytes, k in numbers.items():
        parts += array_parts(_ARRAYS, f"rows{k}", np.frombuffer(ids_bytes, np.int32), named=True)
    if len(freed):
        parts += array_parts(_ARRAYS, "emptied", freed, named=True)
    schema = ", ".join(_column_text(column, kind) for column, kind in table.schema.items())
    header = f'{{"size": {table.size}, "back": {back}, "schema": {{{schema}}}, "rows": {json.dumps(changed)}}}'
    return [bytes_field(_LAYOUT, header.encode()), *parts]


def _changed_rows(before: Table, table: Table, column: str, freed: NDArray[np.int32]) -> NDArray[np.int32]:
    """(n,) rows of a column that are new, or other bytes than before (NaN is no change); without those of the chunks just freed."""
    added = np.arange(before.size, table.size, dtype=np.int32)
    if table.same_memory(column, before):
        ids = added
    else:
        old, new = _words(before.shared(column)), _words(table.shared(column)[: before.size])
        differ = (old != new).reshape(max(before.size, 1), -1).any(axis=1)
        ids = np.concatenate([np.flatnonzero(differ).astype(np.int32), added])
    return ids[~np.isin(ids // CHUNK, freed)] if len(freed) else ids


def _words(rows: Any) -> Any:
    """The bytes of rows, one after another, as (n,) unsigned numbers, the largest that divide a row."""
    size = rows.nbytes // max(len(rows), 1)
    return rows.reshape(-1).view(next(f"u{word}" for word in (8, 4, 2, 1) if size % word == 0))


@lru_cache(256)
def _column_text(name: str, column: Column) -> str:
    """A column in the schema of a table, as JSON."""
    return f"{json.dumps(name)}: {json.dumps([column.dtype, column.shape, column.step])}"


@dataclass(frozen=True)
class Change:
    """A message's table: its size, and for the columns that changed the numbers (n,) and values of rows, the new ones last."""

    schema: Mapping[str, Column]
    size: int
    back: int
    freed: Any
    columns: Mapping[str, tuple[Any, Any]]

    def check(self, name: str, known: int) -> None:
        """Raise ValueError where rows beyond `known` are missing, freed chunks excepted, or anything does not fit."""
        freed = self.freed
        if freed.dtype != np.int32 or freed.ndim != 1 or (freed[:1] < 0).any() or (np.diff(freed) <= 0).any() or (freed >= self.size // CHUNK).any():
            raise ValueError(f"{name}: freed chunks that the table does not have")
        if not 0 <= known <= self.size or self.size * max(sum(column.row_bytes for column in self.schema.values()), ROW_NUMBER) > MAX_BYTES:
            raise ValueError(f"{name}: a table of {self.size} rows")
        if self.size - known > len(freed) * CHUNK + min((len(ids) for ids, _ in self.columns.values()), default=0):
            raise ValueError(f"{name}: rows are missing")
        added = np.arange(known, self.size)
        added = added[~np.isin(added // CHUNK, freed)]
        if len(added) and len(self.columns) < max(len(self.schema), 1):
            raise ValueError(f"{name}: rows are missing")
        checked: set[int] = set()  # columns share their lists of rows
        for column, (ids, values) in self.columns.items():
            kind = self.schema[column]
            if values.dtype != kind.element or values.shape != (len(ids), *kind.shape):
                raise ValueError(f"{name}.{column}: rows of another size")
            if id(ids) not in checked:
                checked.add(id(ids))
                if ids.dtype != np.int32 or (ids[:1] < 0).any() or (np.diff(ids) <= 0).any():
                    raise ValueError(f"{name}.{column}: rows of another size")
                if not np.array_equal(ids[int(np.searchsorted(ids, known)) :], added):
                    raise ValueError(f"{name}.{column}: rows are missing")


def change_of(name: str, arrays: Mapping[str, Any]) -> Change:
    """Decode the change of a table from the arrays of a message. Raises KeyError, TypeError or ValueError where they are none."""
    header = json.loads(arrays[f"{name}#"])
    schema = {column: _column(dtype, tuple(shape), step) for column, (dtype, shape, step) in header["schema"].items()}
    columns = {column: (arrays[f"{name}#rows{k}"], arrays[f"{name}#{column}"]) for column, k in header["rows"].items()}
    freed = arrays.get(f"{name}#emptied", np.empty(0, np.int32))
    if not all(isinstance(array, np.ndarray) for array in (freed, *(part for pair in columns.values() for part in pair))):
        raise TypeError(f"{name}: texts or numbers instead of rows")
    return Change(schema, int(header["size"]), messages_back(header), freed, columns)


def messages_back(header: Mapping[str, Any]) -> int:
    """Read `back` of a header; until format 3 it was `full`."""
    return int(header["back"]) if "back" in header else int(not header["full"])


@lru_cache(256)
def _column(dtype: str, shape: tuple[int, ...], step: float) -> Column:
    if element_type(dtype).hasobject:
        raise ValueError(f"a column of type {dtype!r}")
    if not all(isinstance(length, int) and length >= 0 for length in shape):
        raise ValueError(f"a column of shape {shape}")
    if not (np.isfinite(step) and step >= 0.0):
        raise ValueError(f"a column in steps of {step!r}")
    return Column(dtype, shape, step)


class TableReader:
    """One table of the values of a topic, message by message."""

    def __init__(self) -> None:
        self._latest: Table | None = None
        self._checkpoint: Table | None = None
        self._back = 0

    def next(self, name: str, change: Change) -> Table:
        """Apply the next change. Raises ValueError where it does not fit."""
        self._back += 1
        known = self._latest if change.back == 1 else self._checkpoint if change.back == self._back else None
        self._latest = _apply_change(name, known, change)
        if change.back != 1:
            self._checkpoint, self._back = self._latest, 0
        return self._latest


def _apply_change(name: str, known: Table | None, change: Change) -> Table:
    """Apply a change to a version, which stays as it is."""
    table = known if change.back else Table.empty(change.schema)
    if table is None or table.schema != change.schema:
        raise ValueError(f"{name}: a change without the version before it")
    change.check(name, table.size)
    size, grows = table.size, change.size > table.size
    added = {column: np.zeros((change.size - size, *kind.shape), kind.element) for column, kind in change.schema.items()} if grows else {}
    for column, (ids, values) in change.columns.items():
        old = int(np.searchsorted(ids, size))
        table = table.updated(ids[:old], **{column: values[:old]})
        if added:
            added[column][ids[old:] - size] = values[old:]
    table = table.appended(**added)[0] if added else table
    return table.emptied(change.freed) if len(change.freed) else table


def apply_changes(name: str, changes: Sequence[Change]) -> Table:
    """Apply changes of which each builds on the one before, without making the versions between. Raises ValueError where they do not fit."""
    changes = changes[max((k for k, change in enumerate(changes) if change.back == 0), default=0) :]
    schema, size = changes[0].schema, 0
    if changes[0].back or any(change.schema != schema for change in changes):
        raise ValueError(f"{name}: a change without the version before it")
    for change in changes:
        change.check(name, size)
        size = change.size
    columns = {column: np.zeros((size, *kind.shape), kind.element) for column, kind in schema.items()}
    freed: set[int] = set()
    for change in changes:
        for column, (ids, values) in change.columns.items():
            columns[column][ids] = values
        if freed:
            freed.difference_update(*_chunks(ids for ids, _ in change.columns.values()))
        for number in change.freed.tolist():
            freed.add(number)
            for rows in columns.values():
                rows[number * CHUNK : (number + 1) * CHUNK] = 0
    return Table.of_columns(schema, size, columns, frozenset(freed))


def _chunks(lists: Iterable[Any]) -> list[list[int]]:
    """The numbers of the chunks in which rows lie."""
    return [(ids // CHUNK).tolist() for ids in {id(ids): ids for ids in lists}.values()]
