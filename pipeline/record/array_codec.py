"""One array, text or number as `trihedron.Array {name, dtype, shape, encoding, data}` and back, bit for bit.

`encoding` is one of
- raw: the elements, row by row;
- columns: the bytes of the rows as a matrix (row, byte), transposed. The high bytes of neighbours are alike, and equal columns (of a symmetric
  matrix, say) become equal runs, which the compression of the file's chunks finds. Not of `COPIED` fields: what is found in keypoints and segments
  goes on into tracks and the map row by row, and stays in rows, so that it is found again;
- zstd: the elements under zstd (images);
- rows: an image of three channels under zstd, its first row and then what each adds to the one above, modulo 256. A PNG that is as large takes five
  times as long.
"""

from __future__ import annotations

import math
import re
import struct
import threading
from collections.abc import Mapping, Sequence
from functools import cache, lru_cache
from typing import Any

import cv2
import numpy as np
import zstandard
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.record.mcap_chunks import MAX_RATIO
from trihedron.pipeline.record.wire_format import bytes_field, head, varint

ENCODINGS = ("raw", "columns", "zstd", "rows")
MAX_BYTES = 1 << 30  # of one decoded array
DAMAGED = "the file is damaged; record it again"
TRANSPOSED_BYTES = 1536  # smaller arrays are left as they are: of a frame's recording they would spare half a percent
COPIED = {"points_m", "sigma_m", "endpoints_m"}  # in float32; what is worked out of them is not
SCALARS: dict[str, type[Any]] = {"bool": bool, "int": int, "float": float}


def array_parts(name: str, item: Any) -> tuple[bytes, Any]:
    """An array as a field of `trihedron.Value`: what stands before its data, and these."""
    array = np.ascontiguousarray(item)
    head, turned = plain_head(name, array.dtype, array.shape)
    return head, _turned(array) if turned else array


def image_parts(name: str, item: Any) -> tuple[bytes, Any]:
    """The same of an image, whose first axes are height and width."""
    array = np.ascontiguousarray(item)
    if not array.size:
        return array_parts(name, array)
    steps = array.dtype == np.uint8 and array.ndim == 3
    data = _compressor().compress(_row_steps(array).data if steps else array.data)
    return _head(name, _type_name(array.dtype), array.shape, "rows" if steps else "zstd", len(data)), data


@lru_cache(256)
def text_field(name: str, text: str) -> bytes:
    """A text as a field; most are said again and again."""
    data = text.encode()
    return _head(name, "str", (), "", len(data)) + data


class Numbers:
    """Truth values and numbers, each a field: what stands before it never changes, so that all of them are packed at once."""

    def __init__(self, kinds: Mapping[str, type[Any]]) -> None:
        """`kinds` is of SCALARS, by name."""
        codes = [_CODES[kind] for kind in kinds.values()]
        heads = [_head(name, kind.__name__, (), "raw", struct.calcsize(code)) for (name, kind), code in zip(kinds.items(), codes)]
        self._blank: list[Any] = [part for head in heads for part in (head, 0)]
        self._struct = struct.Struct("<" + "".join(f"{len(head)}s{code}" for head, code in zip(heads, codes)))

    def fields(self, numbers: Sequence[Any]) -> bytes:
        """Of as many numbers."""
        filled = self._blank.copy()
        filled[1::2] = numbers
        return self._struct.pack(*filled)


@lru_cache(4096)
def plain_head(name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> tuple[bytes, bool]:
    """What stands before the data of an array that is no image, and whether the bytes of its rows are transposed; most arrays of a run are as large
    as one before."""
    size = dtype.itemsize * math.prod(shape)
    copied = dtype.itemsize == 4 and name.rpartition("#")[2] in COPIED
    turned = size >= TRANSPOSED_BYTES and dtype.itemsize > 1 and not copied
    return _head(name, _type_name(dtype), shape, "columns" if turned else "raw", size), turned


def _turned(array: NDArray[Any]) -> Any:
    """The bytes of rows that lie one after another, transposed."""
    out = np.empty(array.nbytes, np.uint8)
    row_kernels().turn(array.__array_interface__["data"][0], len(array), array.nbytes // len(array), out)
    return out.data


@cache
def row_kernels() -> Any:
    """What goes through rows; not before it is needed: a command's help need not wait for numba."""
    from trihedron.pipeline.record import row_kernels

    return row_kernels


def _head(name: str, dtype: str, shape: tuple[int, ...], encoding: str, size: int) -> bytes:
    """A field `arrays` up to its data."""
    before, after = _texts(name, dtype, encoding)
    inner = before + bytes_field(3, b"".join(map(varint, shape))) + after + (head(5, size) if size else b"")
    return head(5, len(inner) + size) + inner


@cache
def _texts(name: str, dtype: str, encoding: str) -> tuple[bytes, bytes]:
    """The fields before and after the shape."""
    return bytes_field(1, name.encode()) + bytes_field(2, dtype.encode()), bytes_field(4, encoding.encode())


@cache
def _type_name(dtype: np.dtype[Any]) -> str:
    return dtype.str.lstrip("<|=")


_CODES: dict[type[Any], str] = {bool: "?", int: "q", float: "d"}  # of `struct`
_kept = threading.local()


def _compressor() -> Any:
    """One of this thread, which keeps its tables."""
    if not hasattr(_kept, "compressor"):
        _kept.compressor = zstandard.ZstdCompressor(level=1)
    return _kept.compressor


def get_array(array: Any, place: str) -> Any:
    """The content of one protobuf Array. Raises RecordingError, beginning with `place`, unless its bytes match its declared shape."""
    if array.dtype == "str":
        return array.data.decode("utf-8", "replace")
    dtype = element_type({"bool": "?", "int": "i8", "float": "f8"}.get(array.dtype, array.dtype))
    shape = tuple(array.shape)
    size = int(np.prod([float(n) for n in shape])) * dtype.itemsize if shape else dtype.itemsize
    if dtype.hasobject or any(n < 0 for n in shape) or size > MAX_BYTES or (shape and array.dtype in SCALARS):
        raise RecordingError(place, f"array '{array.name}' claims type {array.dtype!r} and shape {shape}", DAMAGED)
    if array.encoding not in ENCODINGS:
        cause = f"array '{array.name}' has the encoding '{array.encoding[:40]}', this program reads {', '.join(ENCODINGS)}"
        raise RecordingError(place, cause, "read it with the version that wrote it")
    data = _plain(array, shape, size)
    if data is None or len(data) != size:
        raise RecordingError(place, f"array '{array.name}' does not have the {size} bytes of its shape {shape}", DAMAGED)
    content = np.frombuffer(data, dtype).reshape(shape)
    return SCALARS[array.dtype](content[()]) if array.dtype in SCALARS else content


def element_type(name: str) -> np.dtype[Any]:
    """The type of that name, `object` for any but numbers and truth values: NumPy would read more into a text."""
    return np.dtype(name if re.fullmatch(r"\?|b1|[iu][1248]|f[248]", name) else object)


def _plain(array: Any, shape: tuple[int, ...], size: int) -> bytes | None:
    """The plain bytes of an array, or None when they cannot be had."""
    if array.encoding == "zstd":
        return _unpacked(array.data, size)
    if array.encoding == "rows":
        steps = _unpacked(array.data, size) if len(shape) == 3 and size == int(np.prod(shape)) else None
        return bytes(np.add.accumulate(np.frombuffer(steps, np.uint8).reshape(shape), axis=0, dtype=np.uint8).tobytes()) if steps else None
    if array.encoding == "columns":
        if len(array.data) != size or not size:
            return None
        return bytes(cv2.transpose(np.frombuffer(array.data, np.uint8).reshape(-1, shape[0])).tobytes())
    return bytes(array.data)


def _row_steps(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The first row of an image, and what each other one adds to the one above."""
    steps = image.copy()
    steps[1:] -= image[:-1]
    return steps


def _unpacked(data: bytes, size: int) -> bytes | None:
    """The bytes under zstd, None unless they are as many; nothing is allocated for a claim that is not so."""
    try:
        possible = zstandard.frame_content_size(data) == size <= MAX_RATIO["zstd"] * len(data)
        return bytes(zstandard.ZstdDecompressor().decompress(data)) if possible else None
    except zstandard.ZstdError:
        return None
