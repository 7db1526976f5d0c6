"""One array, text or number as `trihedron.Array {name, dtype, shape, encoding, data}` and back, bit for bit.

`encoding` is one of
- raw: the elements, row by row;
- columns: the bytes of the rows as a matrix (row, byte), transposed. The high bytes of neighbours are alike, and equal columns (of a symmetric
  matrix, say) become equal runs, which the compression of the file's chunks finds;
- png: an image of three channels, R first;
- zstd: the elements under zstd (other images).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import zstandard

from trihedron.pipeline.errors import RecordingError
from trihedron.pipeline.mcap_chunks import MAX_RATIO
from trihedron.pipeline.png import is_whole_png

ENCODINGS = ("raw", "columns", "png", "zstd")
MAX_BYTES = 1 << 30  # of one decoded array
DAMAGED = "the file is damaged; record it again"
TRANSPOSED_BYTES = 512  # smaller arrays are left as they are
PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]  # two thirds of the time of the default, as small
SCALARS: dict[str, type[Any]] = {"bool": bool, "int": int, "float": float}


def put_array(message: Any, name: str, item: Any, image: bool) -> None:
    """Add an array, text or number to `message.arrays`; `image`: its first axes are height and width."""
    if isinstance(item, str):
        message.arrays.add(name=name, dtype="str", data=item.encode())
        return
    scalar = type(item).__name__ if type(item).__name__ in SCALARS else None
    array = np.ascontiguousarray(item)
    shape = () if scalar else array.shape
    encoding, data = "raw", b""
    if image and array.size and array.dtype == np.uint8 and array.ndim == 3:
        encoding, data = "png", bytes(cv2.imencode(".png", array[..., ::-1], PNG)[1])
    elif image and array.size:
        encoding, data = "zstd", zstandard.compress(array.data, 1)
    elif array.nbytes >= TRANSPOSED_BYTES and array.itemsize > 1:
        encoding, data = "columns", cv2.transpose(array.reshape(-1).view(np.uint8).reshape(len(array), -1)).tobytes()
    else:
        data = array.tobytes()
    message.arrays.add(name=name, dtype=scalar or array.dtype.str.lstrip("<|="), shape=shape, encoding=encoding, data=data)


def get_array(array: Any, place: str) -> Any:
    """The content of one protobuf Array. Raises RecordingError, beginning with `place`, unless its bytes match its declared shape."""
    if array.dtype == "str":
        return array.data.decode("utf-8", "replace")
    try:
        dtype = np.dtype({"bool": "?", "int": "i8", "float": "f8"}.get(array.dtype, array.dtype))
    except TypeError:
        dtype = np.dtype(object)
    shape = tuple(array.shape)
    size = int(np.prod([float(n) for n in shape])) * dtype.itemsize if shape else dtype.itemsize
    if dtype.hasobject or any(n < 0 for n in shape) or size > MAX_BYTES:
        raise RecordingError(place, f"array '{array.name}' claims type {array.dtype!r} and shape {shape}", DAMAGED)
    if array.encoding not in ENCODINGS:
        cause = f"array '{array.name}' has the encoding '{array.encoding[:40]}', this program reads {', '.join(ENCODINGS)}"
        raise RecordingError(place, cause, "read it with the version that wrote it")
    data = _plain(array, shape, size)
    if data is None or len(data) != size:
        raise RecordingError(place, f"array '{array.name}' does not have the {size} bytes of its shape {shape}", DAMAGED)
    content = np.frombuffer(data, dtype).reshape(shape)
    return SCALARS[array.dtype](content[()]) if array.dtype in SCALARS else content


def _plain(array: Any, shape: tuple[int, ...], size: int) -> bytes | None:
    """The plain bytes of an array, or None when they cannot be had."""
    if array.encoding == "png":
        return _image(array.data, shape)
    if array.encoding == "zstd":
        try:
            claimed = zstandard.frame_content_size(array.data)  # what would be allocated
            possible = claimed == size <= MAX_RATIO["zstd"] * len(array.data)
            return bytes(zstandard.ZstdDecompressor().decompress(array.data)) if possible else None
        except zstandard.ZstdError:
            return None
    if array.encoding == "columns":
        if len(array.data) != size or not size:
            return None
        return bytes(cv2.transpose(np.frombuffer(array.data, np.uint8).reshape(-1, shape[0])).tobytes())
    return bytes(array.data)


def _image(data: bytes, shape: tuple[int, ...]) -> bytes | None:
    """The RGB bytes of a PNG of this shape; one whose header claims another is not decoded."""
    if len(shape) != 3 or not is_whole_png(data) or (int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big"), 3) != shape:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    except cv2.error:
        return None
    return bytes(image.tobytes()) if image is not None else None
