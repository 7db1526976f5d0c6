"""Values to bytes and back, without generated code: one protobuf message `trihedron.Value` holds any value as named arrays.

Anyone can read it with the schema that stands in the file: `type, version, index, stamp_ns` and `{name, dtype, shape, encoding, data}` per
field; nested fields have dotted names, scalars no shape. Images are PNG, float images byte planes under zstd (both lossless, so a replay sees
the same bits). Tables (see `table`) are written as the chunks that changed since the topic's previous message, and whole every `FULL_EVERY`.
Nothing here evaluates what it reads: no pickle, and an array's bytes must be as long as its shape says.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, get_type_hints

import cv2
import numpy as np
import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from trihedron.pipeline import types
from trihedron.pipeline.arrays import array_specs
from trihedron.pipeline.errors import RecordingError
from trihedron.pipeline.table import CHUNK, Column, Table
from trihedron.pipeline.types import Value

FULL_EVERY = 50
MAX_BYTES = 1 << 30  # of one decoded array
_DAMAGED = "the file is damaged; record it again"
_TYPES: dict[str, type[Value]] = {
    name: kind for name, kind in vars(types).items() if isinstance(kind, type) and issubclass(kind, Value) and kind is not Value
}
_SCALARS: dict[str, type[Any]] = {"bool": bool, "int": int, "float": float}


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

    def encode(self, value: Value) -> Any:
        """The protobuf message of a value; tables relative to the previous call's."""
        message = ValueMessage(type=type(value).__name__, version=value.version, index=value.index, stamp_ns=value.stamp_ns)
        full = self._count % FULL_EVERY == 0
        self._count += 1
        for name, item, image in _items(value):
            if isinstance(item, Table):
                _put_table(message, name, item, None if full else self._tables.get(name))
                self._tables[name] = item
            else:
                _put(message, name, item, image)
        return message


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
            raise RecordingError(self.place, "holds a message that is not a trihedron.Value", _DAMAGED) from error
        kind = _TYPES.get(message.type)
        if kind is None:
            raise RecordingError(self.place, f"holds the unknown type '{message.type}'", "read it with the version that wrote it")
        if kind.version != message.version:
            cause = f"holds {message.type} version {message.version}, this program reads version {kind.version}"
            raise RecordingError(self.place, cause, "record again, or read it with the version that wrote it")
        arrays: dict[str, Any] = {}
        chunks: dict[str, Any] = {}
        for array in message.arrays:
            (chunks if "[" in array.name or array.name.endswith("#") else arrays)[array.name] = _get(array, self.place)
        try:
            return self._build(kind, message, arrays, chunks)
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise RecordingError(self.place, f"frame {message.index}: {message.type} does not fit: {error}", _DAMAGED) from error

    def _build(self, kind: Any, message: Any, arrays: dict[str, Any], chunks: dict[str, Any]) -> Value:
        for name, hint in _hints(kind).items():
            if hint is Table:
                self._tables[name] = arrays[name] = _get_table(name, chunks, self._tables.get(name))
        fields = {**arrays, "index": message.index, "stamp_ns": message.stamp_ns}
        value = _make(kind, fields, "")
        assert isinstance(value, Value)
        return value


@cache
def _hints(kind: Any) -> Mapping[str, Any]:
    hints = get_type_hints(kind)
    return {f.name: hints[f.name] for f in dataclasses.fields(kind)}


@cache
def _images(kind: Any) -> frozenset[str]:
    """Array fields that are images: their first axes are height and width."""
    return frozenset(spec.name for spec in array_specs(kind) if spec.shape.axes[:2] == ("h", "w"))


def _items(value: Any, prefix: str = "") -> Iterator[tuple[str, Any, bool]]:
    """(name, content, whether an image) of each field but index and stamp; nested values flattened."""
    for name in _hints(value.__class__):
        item = getattr(value, name)
        if prefix == "" and name in ("index", "stamp_ns"):
            continue
        if dataclasses.is_dataclass(item) and not isinstance(item, Table):
            yield from _items(item, f"{prefix}{name}.")
        else:
            yield prefix + name, item, name in _images(value.__class__)


def _make(kind: Any, fields: Mapping[str, Any], prefix: str) -> Any:
    """Rebuild a (nested) dataclass from dotted fields."""
    made = {}
    for name, hint in _hints(kind).items():
        nested = dataclasses.is_dataclass(hint) and hint is not Table
        made[name] = _make(hint, fields, f"{prefix}{name}.") if nested and isinstance(hint, type) else fields[prefix + name]
    return kind(**made)


def _put(message: Any, name: str, item: Any, image: bool) -> None:
    if isinstance(item, str):
        message.arrays.add(name=name, dtype="str", data=item.encode())
        return
    scalar = type(item).__name__ if type(item).__name__ in _SCALARS else None
    array = np.ascontiguousarray(item)
    encoding, data = "raw", b""
    if image and array.size and array.dtype == np.uint8:
        encoding, data = "png", _png(array)
    elif image and array.size:
        planes = np.ascontiguousarray(array.reshape(-1).view(np.uint8).reshape(-1, array.itemsize).T)
        encoding, data = "zstd_planes", zstandard.compress(planes.tobytes(), 1)
    else:
        data = array.tobytes()
    message.arrays.add(name=name, dtype=scalar or array.dtype.str.lstrip("<|="), shape=() if scalar else array.shape, encoding=encoding, data=data)


def _png(image: Any) -> bytes:
    bgr = image[..., ::-1] if image.ndim == 3 else image
    return bytes(cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def _get(array: Any, place: str) -> Any:
    """The content of one protobuf Array; its bytes must match its declared shape."""
    if array.dtype == "str":
        return array.data.decode("utf-8", "replace")
    try:
        dtype = np.dtype({"bool": "?", "int": "i8", "float": "f8"}.get(array.dtype, array.dtype))
    except TypeError:
        dtype = np.dtype(object)
    shape = tuple(array.shape)
    size = int(np.prod([float(n) for n in shape])) * dtype.itemsize if shape else dtype.itemsize
    if dtype.hasobject or any(n < 0 for n in shape) or size > MAX_BYTES:
        raise RecordingError(place, f"array '{array.name}' claims type {array.dtype!r} and shape {shape}", _DAMAGED)
    data = _decompress(array, size)
    if data is None or len(data) != size:
        raise RecordingError(place, f"array '{array.name}' does not have the {size} bytes of its shape {shape}", _DAMAGED)
    content = np.frombuffer(data, dtype).reshape(shape)
    return _SCALARS[array.dtype](content[()]) if array.dtype in _SCALARS else content


def _decompress(array: Any, size: int) -> bytes | None:
    """The plain bytes of an array, or None when they cannot be had."""
    if array.encoding == "png":
        image = cv2.imdecode(np.frombuffer(array.data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            return None
        return bytes((image[..., ::-1] if image.ndim == 3 else image).tobytes())
    if array.encoding == "zstd_planes":
        try:
            planes = zstandard.ZstdDecompressor().decompress(array.data, max_output_size=max(size, 1))
        except zstandard.ZstdError:
            return None
        item = np.dtype(array.dtype).itemsize
        return np.ascontiguousarray(np.frombuffer(planes, np.uint8).reshape(item, -1).T).tobytes() if len(planes) == size else None
    return bytes(array.data) if array.encoding in ("raw", "") else None


def _put_table(message: Any, name: str, table: Table, previous: Table | None) -> None:
    """`name#` describes the table; `name.column[i]` holds what `previous` does not have of a chunk: all of it, or the rows that `name.column[i]rows`
    lists."""
    header = {"size": table.size, "full": previous is None, "schema": {c: [s.dtype, list(s.shape)] for c, s in table.schema.items()}}
    _put(message, f"{name}#", json.dumps(header), False)
    for column, chunks in table.chunks.items():
        known = previous.chunks.get(column, ()) if previous is not None else ()
        for i, chunk in enumerate(chunks):
            rows = _changed(known[i], chunk) if i < len(known) else np.arange(len(chunk))
            if 0 < len(rows) < len(chunk):
                _put(message, f"{name}.{column}[{i}]rows", rows.astype(np.uint8), False)
            if len(rows):
                _put(message, f"{name}.{column}[{i}]", chunk[rows], False)


def _changed(known: Any, chunk: Any) -> Any:
    """Rows of a chunk, CHUNK at most, that the one known, no longer than this, does not have. They are compared by their bytes: NaN is no change."""
    if known is chunk:
        return np.empty(0, np.intp)
    before, after = (np.ascontiguousarray(part).reshape(len(part), -1).view(np.uint8).reshape(len(part), -1) for part in (known, chunk))
    return np.concatenate([np.flatnonzero((before != after[: len(before)]).any(axis=1)), np.arange(len(before), len(after))])


def _get_table(name: str, chunks: Mapping[str, Any], previous: Table | None) -> Table:
    header = json.loads(chunks[f"{name}#"])
    if not header["full"] and previous is None:
        raise ValueError(f"{name}: a change without the version before it")
    schema = {column: Column(dtype, tuple(shape)) for column, (dtype, shape) in header["schema"].items()}
    columns = {}
    for column, spec in schema.items():
        count = -(-int(header["size"]) // CHUNK)
        known = previous.chunks[column] if previous is not None and not header["full"] else ()
        parts = tuple(_get_chunk(f"{name}.{column}[{i}]", chunks, known[i : i + 1], int(header["size"]) - i * CHUNK) for i in range(count))
        if any(part.dtype != np.dtype(spec.dtype) or part.shape[1:] != spec.shape for part in parts) or sum(map(len, parts)) != header["size"]:
            raise ValueError(f"{name}.{column}: rows of another size")
        columns[column] = parts
    return Table(schema, int(header["size"]), columns)


def _get_chunk(key: str, chunks: Mapping[str, Any], known: tuple[Any, ...], left: int) -> Any:
    """One chunk of a column, of the last `left` rows: the one known (none or one), changed by what the message says of it."""
    if f"{key}rows" not in chunks:
        return chunks[key] if key in chunks else known[0]
    rows, size = chunks[f"{key}rows"], min(left, CHUNK)
    before = known[0]
    if len(np.union1d(rows, np.arange(len(before)))) != size:
        raise ValueError(f"{key}: rows are missing")
    chunk = np.empty((size, *before.shape[1:]), before.dtype)
    chunk[: len(before)] = before
    chunk[rows] = chunks[key]
    chunk.flags.writeable = False
    return chunk
