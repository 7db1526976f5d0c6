"""Values to bytes and back, without generated code: one protobuf message `trihedron.Value` holds any value as named arrays.

Anyone can read it with the schema in the file: `type, version, index, stamp_ns` and an array (`array_codec`) for each field; nested
fields have dotted names, scalars no shape, and tables are written as their changes (`table_codec`). Nothing here evaluates what it reads, and
nothing is allocated that the file does not hold.
"""

from __future__ import annotations

import dataclasses
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from operator import attrgetter
from typing import Any, get_type_hints

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from trihedron.pipeline.core import types
from trihedron.pipeline.core.arrays import array_specs
from trihedron.pipeline.core.errors import RecordingError, printable
from trihedron.pipeline.core.table import Table
from trihedron.pipeline.core.types import Value
from trihedron.pipeline.record.array_codec import (
    DAMAGED,
    SCALARS,
    Numbers,
    array_parts,
    bytes_field,
    get_array,
    image_parts,
    number_field,
    text_field,
)
from trihedron.pipeline.record.table_codec import TableReader, TableWriter, change_of, joined, messages_back

FORMAT = "4"
READABLE = ("3", FORMAT)  # 3: a table was always a change of the message before
METADATA = "trihedron"  # the name of the metadata record
FRAMES_TOPIC = "frames"  # one FrameReference a frame: what a replay iterates over
TIMING_TOPIC = "/timing"
UPGRADE = "upgrade what can be read of it with: trihedron convert SRC DST.mcap"

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
        self._tables = TableWriter()

    def encode(self, value: Value) -> bytes:
        """A value as the bytes of a `trihedron.Value`; tables relative to those of an earlier call."""
        kind: Any = value.__class__
        layout = _layout(kind)
        parts = [layout.head, _when(value.index, value.stamp_ns)]
        for name, item in zip(layout.arrays, layout.array_values(value)):
            parts += array_parts(name, item)
        for name, item in zip(layout.images, layout.image_values(value)):
            parts += image_parts(name, item)
        if layout.numbers is not None:
            parts.append(layout.numbers.fields(layout.number_values(value)))
        parts += map(text_field, layout.texts, layout.text_values(value))
        if layout.tables:
            parts += self._tables.parts({name: getattr(value, name) for name in layout.tables})
        return b"".join(parts)


@lru_cache(64)
def _when(index: int, stamp_ns: int) -> bytes:
    """The fields that all values of a frame share."""
    return number_field(3, index) + number_field(4, stamp_ns)


Read = Callable[[Value], Sequence[Any]]


@dataclass(frozen=True)
class _Layout:
    """The message of a type: its first bytes, and the dotted names of its fields by kinds, each with a function that reads them from a value."""

    head: bytes
    numbers: Numbers | None
    number_values: Read
    texts: tuple[str, ...]
    text_values: Read
    arrays: tuple[str, ...]
    array_values: Read
    images: tuple[str, ...]
    image_values: Read
    tables: tuple[str, ...]


@cache
def _layout(kind: Any) -> _Layout:
    fields = dict(_fields(kind, ""))
    numbers = {name: hint for name, hint in fields.items() if hint in SCALARS.values()}
    tables = tuple(name for name, hint in _hints(kind).items() if hint is Table)
    texts = tuple(name for name, hint in fields.items() if hint is str)
    seen = {spec.name for spec in array_specs(kind) if spec.shape.axes[:2] == ("h", "w")}  # images: their first axes are height and width
    arrays = tuple(name for name in fields if name not in numbers and name not in texts and name not in seen)
    images = tuple(name for name in fields if name in seen)
    head = bytes_field(1, kind.__name__.encode()) + number_field(2, kind.version)
    packed = Numbers(numbers) if numbers else None
    return _Layout(head, packed, _reader(*numbers), texts, _reader(*texts), arrays, _reader(*arrays), images, _reader(*images), tables)


def _reader(*names: str) -> Read:
    """Make a function that reads these fields of a value."""
    if not names:
        return lambda value: ()
    read = attrgetter(*names)
    return read if len(names) > 1 else lambda value: (read(value),)  # of one name it gives no tuple


def _fields(kind: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """(dotted name, type) of each field but index, stamp and tables."""
    for name, hint in _hints(kind).items():
        if hint is Table or (prefix == "" and name in ("index", "stamp_ns")):
            continue
        if _is_nested(hint):
            yield from _fields(hint, f"{prefix}{name}.")
        else:
            yield prefix + name, hint


class Decoder:
    """Reads the values of one topic, in order. `place` names the file and topic in errors."""

    def __init__(self, place: str) -> None:
        self.place = place
        self._tables: dict[str, TableReader] = defaultdict(TableReader)

    def decode(self, data: bytes) -> Value:
        """A value from its bytes. Raises RecordingError for damaged bytes, an unknown type or another version of a type."""
        return self._made(self._parsed(data), lambda name, arrays: self._tables[name].next(name, change_of(name, arrays)))

    def decode_last(self, chain: Sequence[bytes]) -> Value:
        """The last of messages of which each builds on the one before and the first stands alone. Raises RecordingError as `decode`."""
        parsed = [self._parsed(data) for data in chain]
        earlier = [self._arrays(message)[1] for message in parsed[:-1]]
        return self._made(parsed[-1], lambda name, arrays: joined(name, [change_of(name, tables) for tables in (*earlier, arrays)]))

    def _parsed(self, data: bytes) -> Any:
        message = ValueMessage()
        try:
            message.ParseFromString(data)
        except Exception as error:
            raise RecordingError(self.place, "holds a message that is not a trihedron.Value", DAMAGED) from error
        kind = _TYPES.get(message.type)
        if kind is None:
            raise RecordingError(self.place, f"holds the unknown type '{printable(message.type, 60)}'", "read it with the version that wrote it")
        if kind.version != message.version:
            cause = f"holds {message.type} version {message.version}, this program reads version {kind.version}{_other_fields(message, kind)}"
            raise RecordingError(self.place, cause, UPGRADE if message.version < kind.version else "read it with the version that wrote it")
        return message

    def _arrays(self, message: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """The arrays of fields, and those of tables."""
        arrays: dict[str, Any] = {}
        tables: dict[str, Any] = {}
        for array in message.arrays:
            (tables if "#" in array.name else arrays)[array.name] = get_array(array, self.place)
        return arrays, tables

    def _made(self, message: Any, table: Callable[[str, dict[str, Any]], Table]) -> Value:
        """The value of a message, whose tables are made of their arrays."""
        kind: Any = _TYPES[message.type]
        arrays, tables = self._arrays(message)
        try:
            made = {name: table(name, tables) for name in _layout(kind).tables}
            value = _make(kind, {**arrays, **made, "index": message.index, "stamp_ns": message.stamp_ns}, "")
        except Exception as error:  # a stranger's file: its schema is JSON of any kind
            cause = printable(f"frame {message.index}: {message.type} does not fit: {error}", 200)
            raise RecordingError(self.place, cause, DAMAGED) from error
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


def builds_on(data: bytes) -> int:
    """Return how many messages back stands the one that a message builds on, 0 where it stands alone; 0 for damaged bytes, which decoding reports."""
    message = ValueMessage()
    try:
        message.ParseFromString(data)
        return max((messages_back(json.loads(array.data)) for array in message.arrays if array.name.endswith("#")), default=0)
    except Exception:
        return 0


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
