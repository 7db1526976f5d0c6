"""Values to bytes and back, without generated code: the protobuf message of the value's type (`schemas`), its arrays packed by `array_codec`, its
tables written as their changes (`table_codec`).

Nothing here evaluates what it reads, and nothing is allocated that the file does not hold.
"""

from __future__ import annotations

import dataclasses
import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from operator import attrgetter
from typing import Any

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
    head,
    image_parts,
    number_bytes,
    number_field,
    number_head,
    text_field,
)
from trihedron.pipeline.record.schemas import PACKAGE, TIMING, VALUE_TYPES, hints_of, is_nested, message_class, own_fields
from trihedron.pipeline.record.table_codec import TableReader, TableWriter, apply_changes, bytes_of, change_of, messages_back

FORMAT = "6"
# until 5 embedded images were values; until 4 all values were of one schema; in 3 a table was always a change of the message before
READABLE = ("3", "4", "5", FORMAT)
METADATA = "trihedron"  # the name of the metadata record
FRAMES_TOPIC = "frames"  # one FrameReference a frame: what a replay iterates over
TIMING_TOPIC = "/timing"
UPGRADE = "upgrade what can be read of it with: trihedron convert SRC DST.mcap"
NOT_VALUES = (TIMING, f"{PACKAGE}.Error")  # schemas of ours that are none

LegacyMessage = message_class("Value")  # of every value until format 4; its first fields are those of the others, too


def is_value_schema(name: str) -> bool:
    """Return whether a channel of this schema holds values."""
    return name.startswith(f"{PACKAGE}.") and name not in NOT_VALUES


class Encoder:
    """Writes the values of one topic, in order."""

    def __init__(self) -> None:
        self._tables = TableWriter()

    def encode(self, value: Value) -> bytes:
        """A value as the bytes of the message of its type, arrays last, so that none is there of one that was cut off; tables relative to those of
        an earlier call."""
        kind: Any = value.__class__
        layout = _layout(kind)
        parts: list[Any] = [layout.head, _when(value.index, value.stamp_ns)]
        if layout.numbers is not None:
            parts.append(layout.numbers.fields(layout.number_values(value)))
        parts += map(text_field, layout.texts.values(), layout.text_values(value))
        for (name, field), item in zip(layout.arrays.items(), layout.array_values(value)):
            parts += array_parts(field, name, item)
        for (name, field), item in zip(layout.images.items(), layout.image_values(value)):
            parts += image_parts(field, name, item)
        if layout.tables:
            for name, table in self._tables.parts({name: getattr(value, name) for name in layout.tables}).items():
                parts += [head(layout.tables[name], bytes_of(table)), *table]
        return b"".join(parts)


@lru_cache(64)
def _when(index: int, stamp_ns: int) -> bytes:
    """The fields that all values of a frame share."""
    return number_field(3, index) + number_field(4, stamp_ns)


Read = Callable[[Value], Sequence[Any]]


@dataclass(frozen=True)
class _Layout:
    """The message of a type: its first bytes, and its fields by kinds, name -> number, each with a function that reads them from a value."""

    head: bytes
    numbers: Numbers | None
    number_values: Read
    texts: Mapping[str, int]
    text_values: Read
    arrays: Mapping[str, int]
    array_values: Read
    images: Mapping[str, int]
    image_values: Read
    tables: Mapping[str, int]


@cache
def _layout(kind: Any) -> _Layout:
    fields, hints = own_fields(kind), hints_of(kind)
    seen = {spec.name for spec in array_specs(kind) if spec.shape.axes[:2] == ("h", "w")}  # images: their first axes are height and width
    texts = {name: number for name, number in fields.items() if hints[name] is str}
    tables = {name: number for name, number in fields.items() if hints[name] is Table}
    images = {name: number for name, number in fields.items() if name in seen}
    numbers = dict(_numbers(kind, ""))
    others = {*texts, *tables, *images, *(name.partition(".")[0] for name in numbers)}
    arrays = {name: number for name, number in fields.items() if name not in others}
    first = bytes_field(1, kind.__name__.encode()) + number_field(2, kind.version)
    packed = Numbers(list(numbers.values())) if numbers else None
    return _Layout(first, packed, _reader(*numbers), texts, _reader(*texts), arrays, _reader(*arrays), images, _reader(*images), tables)


def _numbers(kind: Any, prefix: str) -> Iterator[tuple[str, tuple[bytes, Any]]]:
    """Dotted name, bytes before it, and type of each number; a nested value has nothing but numbers."""
    for name, number in own_fields(kind).items():
        hint = hints_of(kind)[name]
        if hint in SCALARS.values():
            yield prefix + name, (number_head(number, hint), hint)
        elif is_nested(hint):
            inner = list(_numbers(hint, f"{prefix}{name}."))
            size = sum(len(before) + number_bytes(of) for _, (before, of) in inner)
            (first, (before, of)), *others = inner
            yield first, (head(number, size) + before, of)
            yield from others


def _reader(*names: str) -> Read:
    """Make a function that reads these fields of a value."""
    if not names:
        return lambda value: ()
    read = attrgetter(*names)
    return read if len(names) > 1 else lambda value: (read(value),)  # of one name it gives no tuple


class Decoder:
    """Reads the values of one topic, in order. `place` names the file and topic in errors."""

    def __init__(self, place: str) -> None:
        self.place = place
        self._tables: dict[str, TableReader] = defaultdict(TableReader)

    def decode(self, data: bytes) -> Value:
        """A value from its bytes. Raises RecordingError for damaged bytes, an unknown type or another version of a type."""
        return self._make_value(self._parse_message(data), lambda name, arrays: self._tables[name].next(name, change_of(name, arrays)))

    def decode_last(self, chain: Sequence[bytes]) -> Value:
        """The last of messages of which each builds on the one before and the first stands alone. Raises RecordingError as `decode`."""
        parsed = [self._parse_message(data) for data in chain]
        earlier = [self._arrays(message)[1] for message in parsed[:-1]]
        return self._make_value(parsed[-1], lambda name, arrays: apply_changes(name, [change_of(name, tables) for tables in (*earlier, arrays)]))

    def _parse_message(self, data: bytes) -> Any:
        try:
            message = LegacyMessage.FromString(data)
        except Exception as error:
            raise RecordingError(self.place, "holds a message that is no value of trihedron", DAMAGED) from error
        kind = VALUE_TYPES.get(message.type)
        if kind is None:
            raise RecordingError(self.place, f"holds the unknown type '{printable(message.type, 60)}'", "read it with the version that wrote it")
        if kind.version != message.version:
            cause = f"holds {message.type} version {message.version}, this program reads version {kind.version}{_other_fields(message, kind)}"
            raise RecordingError(self.place, cause, UPGRADE if message.version < kind.version else "read it with the version that wrote it")
        if message.arrays:
            return message
        try:
            return message_class(message.type).FromString(data)
        except Exception as error:
            raise RecordingError(self.place, f"holds a message that is no trihedron.{message.type}", DAMAGED) from error

    def _arrays(self, message: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        """The fields by dotted names, and the arrays of tables."""
        fields: dict[str, Any] = {}
        tables: dict[str, Any] = {}
        if isinstance(message, LegacyMessage):
            for array in message.arrays:
                (tables if "#" in array.name else fields)[array.name] = get_array(array, self.place)
        else:
            self._read(message, VALUE_TYPES[message.type], "", fields, tables)
        return fields, tables

    def _read(self, message: Any, kind: Any, prefix: str, fields: dict[str, Any], tables: dict[str, Any]) -> None:
        """Read the fields of a type's message; an array that is not there stays away."""
        for name in own_fields(kind):
            hint, found = hints_of(kind)[name], getattr(message, name)
            if is_nested(hint):
                if message.HasField(name):
                    self._read(found, hint, f"{prefix}{name}.", fields, tables)
            elif hint is Table:
                tables[f"{name}#"] = found.layout
                tables |= {f"{name}#{array.name}": get_array(array, self.place) for array in found.arrays}
            elif hint is str or hint in SCALARS.values():
                fields[prefix + name] = found
            elif message.HasField(name):
                fields[prefix + name] = get_array(found, self.place, name)

    def _make_value(self, message: Any, table: Callable[[str, dict[str, Any]], Table]) -> Value:
        """The value of a message, whose tables are made of their arrays."""
        kind: Any = VALUE_TYPES[message.type]
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
    if not message.arrays:
        return ""
    types = {spec.name: spec.dtype.str.lstrip("<|=") for spec in array_specs(kind)}
    recorded = {array.name.partition("#")[0].partition(".")[0] for array in message.arrays}
    expected = set(hints_of(kind)) - {"index", "stamp_ns"}
    lacks = ", ".join(f"'{name}'" for name in sorted(expected - recorded))
    more = ", ".join(f"'{name}'" for name in sorted(recorded - expected))
    others = ", ".join(f"'{array.name}' of type {array.dtype}" for array in message.arrays if array.dtype != types.get(array.name, array.dtype))
    if others:
        return f", with its field {others}"
    if not lacks and not more and Table in hints_of(kind).values():
        return ", whose tables have other columns"
    return (f", with the field {lacks} that it lacks" if lacks else "") + (f", without its field {more}" if more else "")


def builds_on(data: bytes) -> int:
    """Return how many messages back stands the one that a message builds on, 0 where it stands alone; 0 for damaged bytes, which decoding reports."""
    try:
        message = LegacyMessage.FromString(data)
        layouts = [array.data for array in message.arrays if array.name.endswith("#")]
        if not message.arrays:
            kind: Any = VALUE_TYPES[message.type]
            own = message_class(message.type).FromString(data)
            layouts = [getattr(own, name).layout for name in _layout(kind).tables]
        return max((messages_back(json.loads(layout)) for layout in layouts), default=0)
    except Exception:
        return 0


def timing_of(data: bytes) -> dict[str, Any]:
    """Read a message of `/timing`: `index`, `frame_ms`, `stage_ms` by stage, `memory_mb`; until format 4 it was JSON."""
    if data[:1] == b"{":
        found: dict[str, Any] = json.loads(data)
        return found
    message = message_class("Timing").FromString(data)
    stages = {field.name: ms for field, ms in message.stage_ms.ListFields()}
    return {"index": message.index, "frame_ms": message.frame_ms, "stage_ms": stages, "memory_mb": message.memory_mb}


def _make(kind: Any, fields: Mapping[str, Any], prefix: str) -> Any:
    """Rebuild a (nested) dataclass from dotted fields; what a message does not hold, written before the field was added, is the field's default."""
    missing = dataclasses.MISSING
    later = {one.name for one in dataclasses.fields(kind) if one.default is not missing or one.default_factory is not missing}
    made = {}
    for name, hint in hints_of(kind).items():
        if prefix + name in fields or is_nested(hint) or name not in later:
            made[name] = _make(hint, fields, f"{prefix}{name}.") if is_nested(hint) else fields[prefix + name]
    return kind(**made)
