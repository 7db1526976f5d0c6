"""Values to bytes and back, without generated code: one protobuf message `trihedron.Value` holds any value as named arrays.

Anyone can read it with the schema that stands in the file: `type, version, index, stamp_ns` and an array (`array_codec`) for each field; nested
fields have dotted names, scalars no shape. Tables (see `table`) are written as the rows that changed since the topic's previous message, and
whole every `FULL_EVERY`: `points#` is a JSON text with `size`, `full`, `schema` and, for each column that changed, the number k of its list of
rows, `points#rows<k>`; `points#position_m` holds these rows, and `points#emptied` the numbers of the chunks that were given back. Nothing here
evaluates what it reads, and nothing is allocated that the file does not hold.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from typing import Any, get_type_hints

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from trihedron.pipeline import types
from trihedron.pipeline.array_codec import DAMAGED, array_parts, element_type, get_array
from trihedron.pipeline.arrays import array_specs
from trihedron.pipeline.errors import RecordingError
from trihedron.pipeline.table import CHUNK, Column, Table
from trihedron.pipeline.types import Value
from trihedron.pipeline.wire_format import bytes_field, number_field

FULL_EVERY = 50
_TYPES: dict[str, type[Value]] = {
    name: kind for name, kind in vars(types).items() if isinstance(kind, type) and issubclass(kind, Value) and kind is not Value
}


def _message_class() -> Any:
    """The protobuf class of `trihedron.Value`."""
    field = descriptor_pb2.FieldDescriptorProto
    text, number64, data = field.TYPE_STRING, field.TYPE_INT64, field.TYPE_BYTES
    file = descriptor_pb2.FileDescriptorProto(name="trihedron/value.proto", package="trihedron", syntax="proto3")
    array = file.message_type.add(name="Array")
    for number, (name, kind) in enumerate([("name", text), ("dtype", text), ("shape", number64), ("encoding", text), ("data", data)], 1):
        array.field.add(name=name, number=number, type=kind, label=field.LABEL_REPEATED if name == "shape" else field.LABEL_OPTIONAL)
    value = file.message_type.add(name="Value")
    for number, (name, kind) in enumerate([("type", text), ("version", field.TYPE_INT32), ("index", number64), ("stamp_ns", number64)], 1):
        value.field.add(name=name, number=number, type=kind, label=field.LABEL_OPTIONAL)
    value.field.add(name="arrays", number=5, type=field.TYPE_MESSAGE, type_name=".trihedron.Array", label=field.LABEL_REPEATED)
    pool = descriptor_pool.Default()
    pool.Add(file) if hasattr(pool, "Add") else pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("trihedron.Value"))


ValueMessage = _message_class()


class Encoder:
    """Writes the values of one topic, in order."""

    def __init__(self) -> None:
        self._tables: dict[str, Table] = {}
        self._count = 0

    def encode(self, value: Value) -> bytes:
        """A value as the bytes of a `trihedron.Value`; tables relative to the previous call's."""
        kind: Any = value.__class__
        layout = _layout(kind)
        parts = [layout.head, number_field(3, value.index), number_field(4, value.stamp_ns)]
        for name, image, item in zip(layout.names, layout.images, layout.content(value)):
            parts += array_parts(name, item, image)
        full = self._count % FULL_EVERY == 0
        self._count += 1
        for name in layout.tables:
            table: Table = getattr(value, name)
            known = None if full else self._tables.get(name)
            if known is not None and (known.schema != table.schema or known.size > table.size):  # another table
                known = None
            parts += _table_parts(name, table, known)
            self._tables[name] = table
        return b"".join(parts)


@dataclass(frozen=True)
class _Layout:
    """What the message of a type is made of: its first bytes, the dotted names of all but tables, which of these are images, and what reads them."""

    head: bytes
    names: tuple[str, ...]
    images: tuple[bool, ...]
    tables: tuple[str, ...]
    content: Callable[[Value], Sequence[Any]]


@cache
def _layout(kind: Any) -> _Layout:
    names, images = zip(*_names(kind, ""))
    tables = tuple(name for name, hint in _hints(kind).items() if hint is Table)
    read = attrgetter(*names, names[0])  # of one name alone it would give no tuple
    return _Layout(bytes_field(1, kind.__name__.encode()) + number_field(2, kind.version), names, images, tables, read)


def _names(kind: Any, prefix: str) -> Iterator[tuple[str, bool]]:
    """(dotted name, whether an image) of each field but index, stamp and tables."""
    images = {spec.name for spec in array_specs(kind) if spec.shape.axes[:2] == ("h", "w")}  # its first axes are height and width
    for name, hint in _hints(kind).items():
        if hint is Table or (prefix == "" and name in ("index", "stamp_ns")):
            continue
        if _is_nested(hint):
            yield from _names(hint, f"{prefix}{name}.")
        else:
            yield prefix + name, name in images


class Decoder:
    """Reads the values of one topic, in order. `place` names the file and topic in errors."""

    def __init__(self, place: str) -> None:
        self.place = place
        self._tables: dict[str, Table] = {}

    def decode(self, data: bytes) -> Value:
        """A value from its bytes. Raises RecordingError for damaged bytes, an unknown type or another version of a type."""
        message = ValueMessage()
        try:
            message.ParseFromString(data)
        except Exception as error:
            raise RecordingError(self.place, "holds a message that is not a trihedron.Value", DAMAGED) from error
        kind = _TYPES.get(message.type)
        if kind is None:
            raise RecordingError(self.place, f"holds the unknown type '{message.type}'", "read it with the version that wrote it")
        if kind.version != message.version:
            cause = f"holds {message.type} version {message.version}, this program reads version {kind.version}{_other_fields(message, kind)}"
            raise RecordingError(self.place, cause, "record again, or read it with the version that wrote it")
        arrays: dict[str, Any] = {}
        tables: dict[str, Any] = {}
        for array in message.arrays:
            (tables if "#" in array.name else arrays)[array.name] = get_array(array, self.place)
        try:
            return self._build(kind, message, arrays, tables)
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise RecordingError(self.place, f"frame {message.index}: {message.type} does not fit: {error}", DAMAGED) from error

    def _build(self, kind: Any, message: Any, arrays: dict[str, Any], tables: dict[str, Any]) -> Value:
        for name, hint in _hints(kind).items():
            if hint is Table:
                self._tables[name] = arrays[name] = _get_table(name, tables, self._tables.get(name))
        fields = {**arrays, "index": message.index, "stamp_ns": message.stamp_ns}
        value = _make(kind, fields, "")
        assert isinstance(value, Value)
        return value


def _other_fields(message: Any, kind: Any) -> str:
    """The fields by which a recorded value differs from the type of today, as a part of a sentence."""
    types = {spec.name: spec.dtype.str.lstrip("<|=") for spec in array_specs(kind)}
    recorded = {array.name.partition("#")[0].partition(".")[0] for array in message.arrays}
    expected = set(_hints(kind)) - {"index", "stamp_ns"}
    lacks = ", ".join(f"'{name}'" for name in sorted(expected - recorded))
    more = ", ".join(f"'{name}'" for name in sorted(recorded - expected))
    others = ", ".join(f"'{array.name}' of type {array.dtype}" for array in message.arrays if array.dtype != types.get(array.name, array.dtype))
    if others:
        return f", with its field {others}"
    if not lacks and not more and Table in _hints(kind).values():
        return ", whose tables have other columns"
    return (f", with the field {lacks} that it lacks" if lacks else "") + (f", without its field {more}" if more else "")


def is_whole(data: bytes) -> bool:
    """Whether a message can be decoded without those before it. Damaged bytes are: decoding says what is wrong with them."""
    message = ValueMessage()
    try:
        message.ParseFromString(data)
        return all(json.loads(array.data)["full"] for array in message.arrays if array.name.endswith("#"))
    except Exception:
        return True


@cache
def _hints(kind: Any) -> Mapping[str, Any]:
    hints = get_type_hints(kind)
    return {f.name: hints[f.name] for f in dataclasses.fields(kind)}


def _is_nested(hint: Any) -> bool:
    return dataclasses.is_dataclass(hint) and hint is not Table and isinstance(hint, type)


def _make(kind: Any, fields: Mapping[str, Any], prefix: str) -> Any:
    """Rebuild a (nested) dataclass from dotted fields."""
    made = {}
    for name, hint in _hints(kind).items():
        made[name] = _make(hint, fields, f"{prefix}{name}.") if _is_nested(hint) else fields[prefix + name]
    return kind(**made)


def _table_parts(name: str, table: Table, previous: Table | None) -> list[Any]:
    """The rows of each column that `previous` does not have; columns whose rows are the same share the list of their numbers."""
    parts: list[Any] = []
    changed: dict[str, int] = {}
    numbers: dict[bytes, int] = {}
    before = {column: previous.chunks.get(column, ()) if previous is not None else () for column in table.chunks}
    touched = {column: _others(before[column], chunks) for column, chunks in table.chunks.items()}
    emptied = {i for i in set().union(*touched.values()) if table.is_empty(i)}
    for column, chunks in table.chunks.items():
        here = [i for i in touched[column] if i not in emptied]
        if not here:
            continue
        ids, values = _changed(before[column], chunks, here)
        if len(ids):
            changed[column] = numbers.setdefault(ids.tobytes(), len(numbers))
            parts += array_parts(f"{name}#{column}", values, False)
    for ids_bytes, k in numbers.items():
        parts += array_parts(f"{name}#rows{k}", np.frombuffer(ids_bytes, np.int32), False)
    if emptied:
        parts += array_parts(f"{name}#emptied", np.array(sorted(emptied), np.int32), False)
    schema = {c: [s.dtype, list(s.shape), s.step] for c, s in table.schema.items()}
    parts += array_parts(f"{name}#", json.dumps({"size": table.size, "full": previous is None, "schema": schema, "rows": changed}), False)
    return parts


def _others(known: Sequence[Any], chunks: Sequence[Any]) -> list[int]:
    """Numbers of the chunks that are not the very ones known."""
    same = min(len(known), len(chunks))
    return [i for i in range(same) if known[i] is not chunks[i]] + list(range(same, len(chunks)))


def _changed(known: Sequence[Any], chunks: Sequence[Any], here: list[int]) -> tuple[Any, Any]:
    """Numbers and values of the rows of the chunks `here` that those known, none longer than these, do not have. They are compared by their bytes:
    NaN is no change."""
    rows, before = _joined([chunks[i] for i in here]), [known[i] for i in here if i < len(known)]
    numbers = (np.array(here, np.int32)[:, None] * CHUNK + _IN_CHUNK).reshape(-1)[: len(rows)]
    if not before:
        return numbers, rows
    differ = np.ones(len(rows), np.bool_)
    old = _joined(before)  # all but the last are full, so that these are the first rows
    differ[: len(old)] = (_words(old) != _words(rows[: len(old)])).any(axis=1)
    return numbers[differ], rows[differ]


_IN_CHUNK = np.arange(CHUNK, dtype=np.int32)


def _joined(parts: list[Any]) -> Any:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _words(rows: Any) -> Any:
    """Rows as the largest whole numbers that they are made of."""
    word = math.gcd(rows.itemsize * math.prod(rows.shape[1:]), 8)
    return rows.reshape(len(rows), -1).view(f"u{word}").reshape(len(rows), -1)


def _get_table(name: str, tables: Mapping[str, Any], previous: Table | None) -> Table:
    header = json.loads(tables[f"{name}#"])
    schema = {column: _column(*said) for column, said in header["schema"].items()}
    table = Table.empty(schema) if header["full"] else previous
    if table is None or table.schema != schema:
        raise ValueError(f"{name}: a change without the version before it")
    size, known, empty = int(header["size"]), table.size, tables.get(f"{name}#emptied", np.empty(0, np.int32))
    if empty.dtype != np.int32 or empty.ndim != 1 or (empty[:1] < 0).any() or (np.diff(empty) <= 0).any() or (empty >= size // CHUNK).any():
        raise ValueError(f"{name}: chunks that are not there")
    count = size - known - int(np.minimum(np.maximum((empty.astype(np.int64) + 1) * CHUNK - known, 0), CHUNK).sum())  # of new rows that are there
    added = {column: Table.empty(schema).column(column) for column in schema}
    for column, k in header["rows"].items():
        ids, values = tables[f"{name}#rows{k}"], tables[f"{name}#{column}"]
        old = int(np.searchsorted(ids, known))
        fits = values.dtype == np.dtype(schema[column].dtype) and values.shape == (len(ids), *schema[column].shape)
        if not fits or ids.dtype != np.int32 or (ids[:1] < 0).any() or (np.diff(ids) <= 0).any():
            raise ValueError(f"{name}.{column}: rows of another size")
        table, added[column] = table.updated(ids[:old], **{column: values[:old]}), values[old:]
        if len(ids) - old != count or not np.array_equal(ids[old:], _there(known, size, empty)):
            raise ValueError(f"{name}.{column}: rows are missing")
    if {len(rows) for rows in added.values()} - {count}:
        raise ValueError(f"{name}: rows are missing")
    return table.extended(size, empty, **added)


def _there(known: int, size: int, empty: Any) -> Any:
    """Rows known..size-1 but for those of the empty chunks."""
    rows = np.arange(known, size)
    return rows[~np.isin(rows // CHUNK, empty)]


def _column(dtype: str, shape: list[int], step: float) -> Column:
    if element_type(dtype).hasobject:
        raise ValueError(f"a column of type {dtype!r}")
    if not (np.isfinite(step) and step >= 0.0):
        raise ValueError(f"a column in steps of {step!r}")
    return Column(dtype, tuple(shape), step)
