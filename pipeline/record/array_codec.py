"""One array as the protobuf message `trihedron.Array {name, dtype, shape, encoding, data}` and back, bit for bit; and packed numbers.

`encoding` is one of
- raw: the elements, row by row;
- columns: the bytes of the rows as a matrix (row, byte), transposed. The high bytes of neighbours are alike, and equal columns (of a symmetric
  matrix, say) become equal runs, which the compression of the file's chunks finds. Not for `COPIED` fields: keypoints and segments go into tracks
  and the map row by row, and compress best as the same bytes;
- zstd: the elements under zstd (images);
- rows: an image of three channels under zstd, its first row and then the difference of each row to the one above, modulo 256. A PNG of the same
  size takes five times as long.

Fields are written as bytes directly: filling objects of the protobuf library and serialising them copies every array twice.
"""

from __future__ import annotations

import math
import re
import struct
import threading
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import cv2
import numpy as np
import zstandard
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import RecordingError, printable
from trihedron.pipeline.record.mcap_file import max_plain_bytes

ENCODINGS = ("raw", "columns", "zstd", "rows")
MAX_BYTES = 1 << 30  # of one decoded array
MAX_AXES = 8
DAMAGED = "the file is damaged; record it again"
TRANSPOSED_BYTES = 1536  # smaller arrays are left as they are: transposing them would spare half a percent of a recording
COPIED = {"points_m", "sigma_m", "endpoints_m"}  # in float32
SCALARS: dict[str, type[Any]] = {"bool": bool, "int": int, "float": float}

# Fields of protobuf messages, as the library would write them.

_VARINT, _FIXED64, _LENGTH = 0, 1, 2  # types of a field on the wire
_SHORT = [bytes((number,)) for number in range(0x80)]


def varint(number: int) -> bytes:
    """Encode seven bits a byte, the lowest first; a negative number as the 64-bit number with its bits."""
    if 0 <= number < 0x80:
        return _SHORT[number]
    if 0 < number < 0x4000:
        return bytes((number & 0x7F | 0x80, number >> 7))
    number &= (1 << 64) - 1
    digits = bytearray()
    while number > 0x7F:
        digits.append(number & 0x7F | 0x80)
        number >>= 7
    digits.append(number)
    return bytes(digits)


def number_field(field: int, number: int) -> bytes:
    """Encode an int32, int64 or enum; nothing for 0."""
    return varint(field << 3 | _VARINT) + varint(number) if number else b""


def head(field: int, size: int) -> bytes:
    """Encode the bytes before a text, bytes, a message or packed numbers of `size` bytes."""
    return varint(field << 3 | _LENGTH) + varint(size)


def bytes_field(field: int, content: bytes) -> bytes:
    """Encode a text or bytes; nothing for empty ones."""
    return head(field, len(content)) + content if content else b""


# Arrays, texts and numbers.


def array_parts(field: int, name: str, item: Any, named: bool = False) -> tuple[bytes, Any]:
    """Encode an array as a field: the bytes before its data, and the data. `named`: with its name, of several in one field."""
    array = np.ascontiguousarray(item)
    before, transposed = _plain_head(field, name, array.dtype, array.shape, named)
    if transposed:
        return before, cv2.transpose(array.view(np.uint8).reshape(len(array), -1)).data
    return before, array


def image_parts(field: int, name: str, item: Any) -> tuple[bytes, Any]:
    """Encode an image, whose first axes are height and width, likewise."""
    array = np.ascontiguousarray(item)
    if not array.size:
        return array_parts(field, name, array)
    steps = array.dtype == np.uint8 and array.ndim == 3
    data = _compressor().compress(_row_steps(array).data if steps else array.data)
    return _head(field, "", _type_name(array.dtype), array.shape, "rows" if steps else "zstd", len(data)), data


@lru_cache(256)
def text_field(field: int, text: str) -> bytes:
    """Encode a text as a field; most repeat."""
    return bytes_field(field, text.encode())


class Numbers:
    """Truth values and numbers, each a field of a fixed size: the bytes before each never change, so that all of them are packed at once."""

    def __init__(self, numbers: Sequence[tuple[bytes, type[Any]]]) -> None:
        """Take what is before each number, and its type, of SCALARS."""
        self._blank: list[Any] = [part for before, _ in numbers for part in (before, 0)]
        self._struct = struct.Struct("<" + "".join(f"{len(before)}s{_CODES[kind]}" for before, kind in numbers))

    def fields(self, numbers: Sequence[Any]) -> bytes:
        """Encode as many numbers."""
        filled = self._blank.copy()
        filled[1::2] = numbers
        return self._struct.pack(*filled)


def number_head(field: int, kind: type[Any]) -> bytes:
    """Encode the bytes before a number of a fixed size: bool, sfixed64, double."""
    return varint(field << 3 | (_VARINT if kind is bool else _FIXED64))


def number_bytes(kind: type[Any]) -> int:
    """Return the bytes of a number of a fixed size."""
    return struct.calcsize(_CODES[kind])


@lru_cache(4096)
def _plain_head(field: int, name: str, dtype: np.dtype[Any], shape: tuple[int, ...], named: bool) -> tuple[bytes, bool]:
    """The bytes before the data of an array that is no image, and whether the bytes of its rows are transposed."""
    size = dtype.itemsize * math.prod(shape)
    copied = dtype.itemsize == 4 and name in COPIED
    transposed = size >= TRANSPOSED_BYTES and dtype.itemsize > 1 and not copied
    return _head(field, name if named else "", _type_name(dtype), shape, "columns" if transposed else "raw", size), transposed


def _head(field: int, name: str, dtype: str, shape: tuple[int, ...], encoding: str, size: int) -> bytes:
    """A field up to its data."""
    before, after = _texts(name, dtype, encoding)
    inner = before + bytes_field(3, b"".join(map(varint, shape))) + after + (head(5, size) if size else b"")
    return head(field, len(inner) + size) + inner


@cache
def _texts(name: str, dtype: str, encoding: str) -> tuple[bytes, bytes]:
    """The fields before and after the shape."""
    return bytes_field(1, name.encode()) + bytes_field(2, dtype.encode()), bytes_field(4, encoding.encode())


@cache
def _type_name(dtype: np.dtype[Any]) -> str:
    return dtype.str.lstrip("<|=")


_CODES: dict[type[Any], str] = {bool: "?", int: "q", float: "d"}  # of `struct`
_of_thread = threading.local()


def _compressor() -> Any:
    """The compressor of this thread."""
    if not hasattr(_of_thread, "compressor"):
        _of_thread.compressor = zstandard.ZstdCompressor(level=1)
    return _of_thread.compressor


def get_array(array: Any, place: str, name: str = "") -> Any:
    """Decode one protobuf Array; until format 4 it could hold a text or a number. Raises RecordingError, beginning with `place`, unless its bytes
    match its declared shape; `name` is that of its field, where it has none of its own."""
    title = f"array '{printable(array.name or name, 60)}'"
    if array.dtype == "str":
        return array.data.decode("utf-8", "replace")
    dtype = element_type({"bool": "?", "int": "i8", "float": "f8"}.get(array.dtype, array.dtype))
    shape = tuple(array.shape)
    if dtype.hasobject or not _is_allowed_shape(shape, dtype.itemsize) or (shape and array.dtype in SCALARS):
        raise RecordingError(place, f"{title} claims type '{printable(array.dtype, 20)}' and shape {shape[:4]}", DAMAGED)
    if array.encoding not in ENCODINGS:
        cause = f"{title} has the encoding '{printable(array.encoding, 40)}', this program reads {', '.join(ENCODINGS)}"
        raise RecordingError(place, cause, "read it with the version that wrote it")
    size = math.prod(shape) * dtype.itemsize
    data = _plain(array, shape, size)
    if data is None or len(data) != size:
        raise RecordingError(place, f"{title} does not have the {size} bytes of its shape {shape}", DAMAGED)
    content = np.frombuffer(data, dtype).reshape(shape)
    return SCALARS[array.dtype](content[()]) if array.dtype in SCALARS else content


def _is_allowed_shape(shape: tuple[int, ...], itemsize: int) -> bool:
    """Check that a shape has few axes and few bytes; beside an axis of length 0 NumPy counts the others, too."""
    return len(shape) <= MAX_AXES and min(shape, default=0) >= 0 and math.prod(max(n, 1) for n in shape) * itemsize <= MAX_BYTES


@lru_cache(64)
def element_type(name: str) -> np.dtype[Any]:
    """The type of that name, `object` for any but numbers and truth values."""
    return np.dtype(name if re.fullmatch(r"\?|b1|[iu][1248]|f[248]", name) else object)


def _plain(array: Any, shape: tuple[int, ...], size: int) -> bytes | None:
    """The plain bytes of an array, or None when they cannot be had."""
    if array.encoding == "zstd":
        return _decompress(array.data, size)
    if array.encoding == "rows":
        steps = _decompress(array.data, size) if len(shape) == 3 and size == int(np.prod(shape)) else None
        return bytes(np.add.accumulate(np.frombuffer(steps, np.uint8).reshape(shape), axis=0, dtype=np.uint8).tobytes()) if steps else None
    if array.encoding == "columns":
        if len(array.data) != size or not size or not shape:
            return None
        return bytes(cv2.transpose(np.frombuffer(array.data, np.uint8).reshape(-1, shape[0])).tobytes())
    return bytes(array.data)


def _row_steps(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The first row of an image, and the difference of each other row to the one above."""
    steps = image.copy()
    steps[1:] -= image[:-1]
    return steps


def _decompress(data: bytes, size: int) -> bytes | None:
    """The bytes under zstd, None unless they are as many."""
    try:
        possible = zstandard.frame_content_size(data) == size <= max_plain_bytes(len(data))
        return bytes(zstandard.ZstdDecompressor().decompress(data)) if possible else None
    except zstandard.ZstdError:
        return None
