"""Tables (see `table`) as arrays of a message, and back: the rows that changed since an earlier message of the topic, or all.

A message changes the one before it. Every `CHECKPOINT_EVERY` it changes the last such checkpoint instead, so that one message is read without all
that came before; where that spares little, or after `MOST_CHECKPOINTS`, it is whole. So what a frame takes does not grow with the map, and neither
does what is read for it.

A table `points` is `points#`, a JSON text with `size`, `back` (how many messages ago the table was that this changes; 0: none, all is here), `schema`
and, for each column that changed, the number k of its list of rows, `points#rows<k>`; `points#position_m` holds these rows, and `points#emptied` the
numbers of the chunks that were given back.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import compress
from operator import is_not
from typing import Any

import numpy as np

from trihedron.pipeline.core.table import CHUNK, Column, Table, empty_chunk
from trihedron.pipeline.record.array_codec import array_parts, element_type, plain_head, row_kernels, text_field

CHECKPOINT_EVERY = 64  # messages; of a walk through what is new a checkpoint adds a third to what the changes take, however far apart they are
MOST_CHECKPOINTS = 16  # that build on each other: reading one frame reads them all
WORTH = 2 / 3  # of the bytes of the whole, which a checkpoint must not exceed


class TableWriter:
    """Writes the tables of the values of one topic, in order."""

    def __init__(self) -> None:
        self._latest: Mapping[str, Table] = {}
        self._checkpoint: Mapping[str, Table] = {}
        self._back = 0  # messages since the checkpoint
        self._checkpoints = 0  # that build on each other

    def parts(self, tables: Mapping[str, Table]) -> list[Any]:
        """The arrays of one value's tables."""
        self._back += 1
        known, latest, self._latest = self._checkpoint, self._latest, tables
        if self._back < CHECKPOINT_EVERY and _goes_on(latest, tables):
            return _parts(tables, latest, 1)
        parts: list[Any] = []
        if self._checkpoints < MOST_CHECKPOINTS and _goes_on(known, tables):
            parts = _parts(tables, known, self._back)
        if not parts or sum(memoryview(part).nbytes for part in parts) > WORTH * sum(map(_bytes_of, tables.values())):
            parts, self._checkpoints = _parts(tables, {}, 0), 0
        self._checkpoint, self._back, self._checkpoints = tables, 0, self._checkpoints + 1
        return parts


def _goes_on(known: Mapping[str, Table], tables: Mapping[str, Table]) -> bool:
    """Whether these are the known ones, grown."""
    return bool(known) and all(known[name].schema == table.schema and known[name].size <= table.size for name, table in tables.items())


def _bytes_of(table: Table) -> int:
    """Of the rows that were not given back."""
    return sum(sum(part.nbytes for part in parts if part is not empty_chunk(table.schema[name])) for name, parts in table.chunks.items())


def _parts(tables: Mapping[str, Table], known: Mapping[str, Table], back: int) -> list[Any]:
    return [part for name, table in tables.items() for part in _table_parts(name, table, known.get(name), back)]


def _table_parts(name: str, table: Table, previous: Table | None, back: int) -> list[Any]:
    """The rows of each column that `previous` does not have; columns whose rows are the same share the list of their numbers."""
    parts: list[Any] = []
    changed: dict[str, int] = {}
    numbers: dict[bytes, int] = {}
    before = previous if previous is not None else Table.empty(table.schema)
    touched = {column: _others(before.chunks[column], chunks) for column, chunks in table.chunks.items()}
    emptied = {i for i in set().union(*touched.values()) if table.is_empty(i)}
    for column, others in touched.items():
        addresses = table.addresses(column, before, others)
        here = [i for i in others if i not in emptied] if emptied else others
        if not here:
            continue
        ids = np.empty(len(here) * CHUNK, np.int32)
        chunks = np.array(here, np.int32)
        row_bytes, shape = table.schema[column].row_bytes, table.schema[column].shape
        count = row_kernels().differing(before.addresses(column), addresses, chunks, CHUNK, before.size, table.size, row_bytes, ids)
        if count:
            ids = ids[:count]
            changed[column] = numbers.setdefault(ids.tobytes(), len(numbers))
            head, turned = plain_head(f"{name}#{column}", table.schema[column].element, (count, *shape))
            rows = np.empty(count * row_bytes, np.uint8)
            row_kernels().take(addresses, ids, CHUNK, row_bytes, turned, rows)
            parts += head, rows.data
    for ids_bytes, k in numbers.items():
        parts += array_parts(f"{name}#rows{k}", np.frombuffer(ids_bytes, np.int32))
    if emptied:
        parts += array_parts(f"{name}#emptied", np.array(sorted(emptied), np.int32))
    schema = ", ".join(_column_text(column, kind) for column, kind in table.schema.items())
    header = f'{{"size": {table.size}, "back": {back}, "schema": {{{schema}}}, "rows": {json.dumps(changed)}}}'
    parts.append(text_field(f"{name}#", header))
    return parts


@lru_cache(256)
def _column_text(name: str, column: Column) -> str:
    """A column in the schema of a table, as JSON."""
    return f"{json.dumps(name)}: {json.dumps([column.dtype, column.shape, column.step])}"


def _others(known: Sequence[Any], chunks: Sequence[Any]) -> list[int]:
    """Numbers of the chunks that are not the very ones known."""
    if known is chunks:
        return []
    return [*compress(range(len(known)), map(is_not, known, chunks)), *range(min(len(known), len(chunks)), len(chunks))]


@dataclass(frozen=True)
class Change:
    """What a message says of a table: its size, and of the columns that changed the numbers (n,) and values of rows, the new ones last."""

    schema: Mapping[str, Column]
    size: int
    back: int
    emptied: Any
    columns: Mapping[str, tuple[Any, Any]]

    def checked(self, name: str, known: int) -> int:
        """The number of rows new beyond `known`, chunks given back apart. Raises ValueError where some are missing, or anything does not fit."""
        empty = self.emptied
        if empty.dtype != np.int32 or empty.ndim != 1 or (empty[:1] < 0).any() or (np.diff(empty) <= 0).any() or (empty >= self.size // CHUNK).any():
            raise ValueError(f"{name}: chunks that are not there")
        count = self.size - known - int(np.minimum(np.maximum((empty.astype(np.int64) + 1) * CHUNK - known, 0), CHUNK).sum())
        if count and len(self.columns) < max(len(self.schema), 1):
            raise ValueError(f"{name}: rows are missing")
        seen: set[int] = set()
        for column, (ids, values) in self.columns.items():
            told = self.schema[column]
            if values.dtype != np.dtype(told.dtype) or values.shape != (len(ids), *told.shape):
                raise ValueError(f"{name}.{column}: rows of another size")
            if id(ids) not in seen:
                seen.add(id(ids))
                if ids.dtype != np.int32 or (ids[:1] < 0).any() or (np.diff(ids) <= 0).any():
                    raise ValueError(f"{name}.{column}: rows of another size")
                fresh = ids[int(np.searchsorted(ids, known)) :]
                if len(fresh) != count or not np.array_equal(fresh, _there(known, self.size, empty)):
                    raise ValueError(f"{name}.{column}: rows are missing")
        return count


def _there(known: int, size: int, empty: Any) -> Any:
    """Rows known..size-1 but for those of the empty chunks."""
    rows = np.arange(known, size)
    return rows[~np.isin(rows // CHUNK, empty)] if len(empty) else rows


def change_of(name: str, arrays: Mapping[str, Any]) -> Change:
    """Of a table, from the arrays of a message. Raises KeyError, TypeError or ValueError where they are none."""
    header = json.loads(arrays[f"{name}#"])
    schema = {column: _column(dtype, tuple(shape), step) for column, (dtype, shape, step) in header["schema"].items()}
    columns = {column: (arrays[f"{name}#rows{k}"], arrays[f"{name}#{column}"]) for column, k in header["rows"].items()}
    emptied = arrays.get(f"{name}#emptied", np.empty(0, np.int32))
    if not all(isinstance(array, np.ndarray) for array in (emptied, *(part for pair in columns.values() for part in pair))):
        raise TypeError(f"{name}: texts or numbers instead of rows")
    return Change(schema, int(header["size"]), messages_back(header), emptied, columns)


def messages_back(header: Mapping[str, Any]) -> int:
    """What `back` says; until format 3 it was `full`."""
    return int(header["back"]) if "back" in header else int(not header["full"])


@lru_cache(256)
def _column(dtype: str, shape: tuple[int, ...], step: float) -> Column:
    if element_type(dtype).hasobject:
        raise ValueError(f"a column of type {dtype!r}")
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
        """The table after the next change. Raises ValueError where it does not fit."""
        self._back += 1
        known = self._latest if change.back == 1 else self._checkpoint if change.back == self._back else None
        self._latest = changed(name, known, change)
        if change.back != 1:
            self._checkpoint, self._back = self._latest, 0
        return self._latest


def changed(name: str, known: Table | None, change: Change) -> Table:
    """A table after a change. Raises ValueError where they do not fit."""
    table = known if change.back else Table.empty(change.schema)
    if table is None or table.schema != change.schema:
        raise ValueError(f"{name}: a change without the version before it")
    change.checked(name, table.size)
    added = {column: Table.empty(change.schema).column(column) for column in change.schema}
    size = table.size
    for column, (ids, values) in change.columns.items():
        old = int(np.searchsorted(ids, size))
        table, added[column] = table.updated(ids[:old], **{column: values[:old]}), values[old:]
    return table.extended(change.size, change.emptied, **added)


def joined(name: str, changes: Sequence[Change]) -> Table:
    """A table after changes of which each goes on from the one before, the first or a later one whole: no version between is made. Raises ValueError
    where they do not fit."""
    changes = changes[max((k for k, change in enumerate(changes) if change.back == 0), default=0) :]
    schema, size = changes[0].schema, 0
    if changes[0].back or any(change.schema != schema for change in changes):
        raise ValueError(f"{name}: a change without the version before it")
    for change in changes:
        change.checked(name, size)
        size = change.size
    dead = np.zeros(-(-size // CHUNK), np.bool_)
    for change in changes:
        if any(dead[ids // CHUNK].any() for ids, _ in change.columns.values()):
            return _one_by_one(name, changes)
        dead[change.emptied] = True
    place = np.cumsum(~dead) - 1  # of each chunk among those there are
    flat = {column: np.empty((size - int(dead.sum()) * CHUNK, *told.shape), told.dtype) for column, told in schema.items()}
    for change in changes:
        found: dict[int, tuple[Any, Any]] = {}  # columns share their lists of rows
        for column, (ids, values) in change.columns.items():
            if id(ids) not in found:
                found[id(ids)] = _places(ids, dead, place) if dead.any() else (ids, slice(None))
            rows, there = found[id(ids)]
            flat[column][rows] = values[there]
    return Table(schema, size, {column: _cut(whole, dead, place, schema[column]) for column, whole in flat.items()})


def _places(ids: Any, dead: Any, place: Any) -> tuple[Any, Any]:
    """Where rows lie in the chunks that are there, and which of them do."""
    number, offset = np.divmod(ids, CHUNK)
    there = ~dead[number]
    return place[number[there]] * CHUNK + offset[there], there


def _cut(whole: Any, dead: Any, place: Any, column: Column) -> tuple[Any, ...]:
    """The chunks of a column that lie one after another in `whole`."""
    whole.flags.writeable = False
    return tuple(empty_chunk(column) if gone else whole[k * CHUNK : (k + 1) * CHUNK] for gone, k in zip(dead.tolist(), place.tolist()))


def _one_by_one(name: str, changes: Sequence[Change]) -> Table:
    """The same where rows came into a chunk that had been given back."""
    table: Table | None = None
    for change in changes:
        table = changed(name, table, change)
    assert table is not None
    return table
