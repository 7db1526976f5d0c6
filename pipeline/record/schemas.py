"""Protobuf schemas of a recording: one message for each type of value, generated from its dataclass, with docstring, shapes and units as comments.

`trihedron.Planes` has the fields of `types.Planes` behind four that all have: `type, version, index, stamp_ns`. Numbers and texts are native, nested
values are messages, an array is a `trihedron.Array`, a table a `trihedron.Table`. `docs/reference/file-formats.md` explains these two.
Until format 4 every value was a `trihedron.Value`, which named its arrays.
"""

from __future__ import annotations

import dataclasses
import inspect
import threading
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, get_type_hints

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from trihedron.pipeline.core import types
from trihedron.pipeline.core.arrays import array_specs
from trihedron.pipeline.core.comments import field_comments
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.table import Table
from trihedron.pipeline.core.types import Value

PACKAGE = "trihedron"
HEADER = ("type", "version", "index", "stamp_ns")  # fields 1 to 4 of every value
LEGACY_ARRAYS = 5  # the field of a `trihedron.Value` that holds its arrays
FIRST = 6  # the number of the first field that is a type's own
TIMING = f"{PACKAGE}.Timing"

_FIELD = descriptor_pb2.FieldDescriptorProto
_TEXT, _INT32, _INT64, _FIXED64, _BYTES = _FIELD.TYPE_STRING, _FIELD.TYPE_INT32, _FIELD.TYPE_INT64, _FIELD.TYPE_SFIXED64, _FIELD.TYPE_BYTES
_NUMBERS = {bool: _FIELD.TYPE_BOOL, int: _FIXED64, float: _FIELD.TYPE_DOUBLE}  # an int has 8 bytes, so that all numbers of a value are packed at once
_HEADER_KINDS = dict(zip(HEADER, (_TEXT, _INT32, _INT64, _INT64)))
_HEADER_COMMENTS = ("name of the type", "of the type's fields", "number of the frame in the data set", "time of the frame, ns")

CONVENTIONS = {  # of all channels, in their metadata
    "ids": "index: the frame's number in the data set; an id of a keyframe or landmark is its row in the map's table, for good",
    "units": "metres, radians, pixels, unless the end of a field's name is another: _deg, _ns, _s, _ms, _mb; log time: the frame's stamp",
    "frames": "camera: x right, y down, z forward; world: the camera of the first frame; T_a_b maps points of b into a: p_a = T_a_b p_b",
}

VALUE_TYPES: dict[str, type[Value]] = {
    name: kind for name, kind in vars(types).items() if isinstance(kind, type) and issubclass(kind, Value) and kind is not Value
}


@cache
def hints_of(kind: Any) -> Mapping[str, Any]:
    """Return field name -> type of a dataclass, in order."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def is_nested(hint: Any) -> bool:
    """Return whether a field is a dataclass, whose fields are recorded one by one."""
    return dataclasses.is_dataclass(hint) and hint is not Table and isinstance(hint, type)


def own_fields(kind: Any) -> dict[str, int]:
    """Return field name -> number in the message, of the fields that are a type's own."""
    names = [name for name in hints_of(kind) if not (issubclass(kind, Value) and name in HEADER)]
    return {name: number for number, name in enumerate(names, FIRST)}


# Files of the schemas.

_ARRAY_COMMENTS = {
    "Array": "An array, row by row. encoding: raw | columns | zstd | rows, see docs/reference/file-formats.md.",
    "Table": "Rows of named columns: all of them, or those that changed since an earlier message. layout is JSON: size, back (messages since "
    "the table that this changes; 0: none, this is all of it), schema {column: [dtype, shape, step]}, rows {column: k}: numbers of rows in rows<k>.",
}


def _array_file() -> Any:
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/array.proto", package=PACKAGE, syntax="proto3")
    array = file.message_type.add(name="Array")
    for number, (name, kind) in enumerate([("name", _TEXT), ("dtype", _TEXT), ("shape", _INT64), ("encoding", _TEXT), ("data", _BYTES)], 1):
        array.field.add(name=name, number=number, type=kind, label=_FIELD.LABEL_REPEATED if name == "shape" else _FIELD.LABEL_OPTIONAL)
    table = file.message_type.add(name="Table")
    table.field.add(name="layout", number=1, type=_TEXT, label=_FIELD.LABEL_OPTIONAL)
    table.field.add(name="arrays", number=2, type=_FIELD.TYPE_MESSAGE, type_name=f".{PACKAGE}.Array", label=_FIELD.LABEL_REPEATED)
    for number, text in enumerate(_ARRAY_COMMENTS.values()):
        _comment(file, (4, number), text)
    return file


def _value_file() -> Any:
    """The schema of every value until format 4."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/value.proto", package=PACKAGE, syntax="proto3", dependency=[_ARRAYS.name])
    value = file.message_type.add(name="Value")
    for number, (name, kind) in enumerate(_HEADER_KINDS.items(), 1):
        value.field.add(name=name, number=number, type=kind, label=_FIELD.LABEL_OPTIONAL)
    value.field.add(name="arrays", number=LEGACY_ARRAYS, type=_FIELD.TYPE_MESSAGE, type_name=f".{PACKAGE}.Array", label=_FIELD.LABEL_REPEATED)
    return file


def _type_file(kind: Any) -> Any:
    """The schema of a type, and of those that are nested in it."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/{kind.__name__}.proto", package=PACKAGE, syntax="proto3", dependency=[_ARRAYS.name])
    for number, part in enumerate(_with_nested(kind)):
        message = file.message_type.add(name=part.__name__ if part is kind else f"{kind.__name__}{part.__name__}")
        _comment(file, (4, number), inspect.cleandoc(part.__doc__ or ""))
        if part is kind:
            for at, (name, header) in enumerate(_HEADER_KINDS.items()):
                message.field.add(name=name, number=at + 1, type=header, label=_FIELD.LABEL_OPTIONAL)
                _comment(file, (4, number, 2, at), _HEADER_COMMENTS[at])
        for name, field_number in own_fields(part).items():
            field = message.field.add(name=name, number=field_number, label=_FIELD.LABEL_OPTIONAL)
            _set_type(field, kind, hints_of(part)[name])
            if text := field_text(part, name):
                _comment(file, (4, number, 2, len(message.field) - 1), text)
    return file


def _set_type(field: Any, kind: Any, hint: Any) -> None:
    """Declare a field of a message of `kind`."""
    if hint in _NUMBERS or hint is str:
        field.type = _NUMBERS.get(hint, _TEXT)
        return
    name = f"{kind.__name__}{hint.__name__}" if is_nested(hint) else "Table" if hint is Table else "Array"
    field.type, field.type_name = _FIELD.TYPE_MESSAGE, f".{PACKAGE}.{name}"


def _with_nested(kind: Any) -> Iterator[Any]:
    yield kind
    for hint in hints_of(kind).values():
        if is_nested(hint):
            yield from _with_nested(hint)


def field_text(kind: Any, name: str) -> str:
    """Describe a field in a line: element type and shape of an array, then the comment in the source."""
    spec = next((spec for spec in array_specs(kind) if spec.name == name), None)
    parts = [f"{spec.dtype.name} {spec.shape}"] if spec is not None else []
    comments = _comments_of(kind)
    return "; ".join([*parts, *([comments[name]] if name in comments else [])])


_comments_of = cache(field_comments)


def _comment(file: Any, path: tuple[int, ...], text: str) -> None:
    file.source_code_info.location.add(path=path, span=(0, 0, 0), leading_comments=f" {text}\n")


def _timing_file() -> Any:
    """The schema of `/timing`: milliseconds of each stage that was called."""
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/timing.proto", package=PACKAGE, syntax="proto3")
    timing, stages = file.message_type.add(name="Timing"), file.message_type.add(name="StageTimes")
    fields = [("index", _INT64, ""), ("frame_ms", _FIELD.TYPE_DOUBLE, ""), ("stage_ms", _FIELD.TYPE_MESSAGE, f".{PACKAGE}.StageTimes")]
    for number, (name, kind, of) in enumerate([*fields, ("memory_mb", _FIELD.TYPE_DOUBLE, "")], 1):
        timing.field.add(name=name, number=number, type=kind, type_name=of or None, label=_FIELD.LABEL_OPTIONAL)
    for number, slot in enumerate(SLOTS, 1):
        stages.field.add(name=slot, number=number, type=_FIELD.TYPE_DOUBLE, label=_FIELD.LABEL_OPTIONAL)
    _comment(file, (4, 0), "Times of a frame; memory_mb is resident, of the whole process.")
    return file


_ARRAYS = _array_file()
_POOL: Any = descriptor_pool.DescriptorPool()
_FILES: dict[str, Any] = {}  # those in the pool
_ADDING = threading.RLock()


def _add_message_file(name: str) -> Any:
    """Add the file that declares a message to the pool, with those it needs; returns it. Several recordings may be written at once."""
    with _ADDING:
        if name not in _FILES:
            _FILES[name] = _add(name)
        return _FILES[name]


def _add(name: str) -> Any:
    makers = {"Array": lambda: _ARRAYS, "Value": _value_file, "Timing": _timing_file}
    file = makers[name]() if name in makers else _type_file(VALUE_TYPES[name])
    if file.dependency:
        _add_message_file("Array")
    _POOL.AddSerializedFile(file.SerializeToString())
    return file


@cache
def message_class(name: str) -> Any:
    """Return the protobuf class of `trihedron.<name>`: a type of value, Value, Timing."""
    _add_message_file(name)
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"{PACKAGE}.{name}"))


def definition(name: str) -> bytes:
    """Return the schema of `trihedron.<name>` as a FileDescriptorSet with comments."""
    file = _add_message_file(name)
    return bytes(descriptor_pb2.FileDescriptorSet(file=[*([_ARRAYS] if file.dependency else []), file]).SerializeToString())


def channel_metadata(name: str) -> dict[str, str]:
    """Return what a reader of a channel of `trihedron.<name>` has to know besides the schema: what it is, its ids, units and frames."""
    about = {"type": name, "meaning": " ".join((inspect.getdoc(VALUE_TYPES[name]) or "").split())} if name in VALUE_TYPES else {"type": name}
    return about | CONVENTIONS
