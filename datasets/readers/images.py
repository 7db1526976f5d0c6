"""Image files -> RGB and metres, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.readers.picture_headers import JPEG, PNG, UnreadableImage, picture_header
from trihedron.datasets.readers.png_chunks import is_whole_png
from trihedron.datasets.readers.png_decoder import decode_png
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import F32, U8

RGB = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
JPEG_END = b"\xff\xd9"  # of a complete file; a decoder would fill the rest of a truncated one with grey and say nothing
PIXELS_PER_BYTE = 2048  # more than a picture can pack: deflate makes 1032 bytes of one, a grey JPEG 512 pixels of one
MOST_PIXELS = 1 << 26  # more than any camera has that sees depth
TAIL = 64  # bytes searched for the end mark: writers may pad


def read_color(path: Path) -> U8:
    """(h, w, 3) RGB. Raises UnreadableImage for a missing or damaged file, DataError for an image that is not 8-bit colour."""
    image = _decode(path)
    if image.dtype != np.uint8:
        cause = f"has {8 * image.itemsize} bits a channel where colour has 8"
        raise DataError(str(path), cause, "give 8-bit RGB images; are colour and depth swapped?")
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise DataError(str(path), f"has {channels} channel{'s' * (channels != 1)} where colour has 3", "convert it to an RGB image")
    return np.asarray(image if image.shape[2] == 3 else cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), dtype=np.uint8)


def read_depth(path: Path, depth_scale: float, depth_offset: float = 0.0) -> F32:
    """(h, w) metres, 0 = none, from a 16-bit image whose value divided by `depth_scale` is metres z, corrected to 1 / (1 / z + `depth_offset`).

    Raises UnreadableImage for a missing or damaged file, DataError for an image that is not 16-bit with one channel."""
    image = _decode(path)
    if image.ndim != 2:
        raise DataError(str(path), f"has {image.shape[2]} channels where depth has 1", "give 16-bit depth images with one channel")
    if image.dtype != np.uint16:
        cure = "give 16-bit depth images (value = metres × depth_scale); a preview picture does not hold metres"
        raise DataError(str(path), f"has {8 * image.itemsize} bits a pixel where depth has 16", cure)
    return corrected(metres(image, depth_scale), depth_offset)


def corrected(depth: F32, depth_offset: float) -> F32:
    """Depth z in metres as 1 / (1 / z + `depth_offset`), float32."""
    return depth / np.maximum(1.0 + np.float32(depth_offset) * depth, np.float32(0.1)) if depth_offset else depth


def metres(values: NDArray[Any], depth_scale: float) -> F32:
    """Whole numbers divided by `depth_scale`, (h, w) float32."""
    depth: F32 = values.astype(np.float32)
    depth /= np.float32(depth_scale)
    return depth


def _decode(path: Path) -> NDArray[Any]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnreadableImage(f"cannot be opened ({error.strerror})") from error
    if not data:
        raise UnreadableImage("is empty")
    return decode_image(data)


def decode_image(data: bytes) -> NDArray[Any]:
    """The pixels of a picture: (h, w), (h, w, 3) RGB or (h, w, 4) RGBA. Raises UnreadableImage for another format (see `picture_headers`) and for
    what is cut off, damaged or larger than its bytes can hold."""
    header = picture_header(data)
    if header.cells > min(PIXELS_PER_BYTE * len(data), MOST_PIXELS):
        raise UnreadableImage(f"claims {header.width}×{header.height} pixels in {len(data)} bytes")
    if (data.startswith(PNG) and not is_whole_png(data)) or (data.startswith(JPEG) and JPEG_END not in data[-TAIL:]):
        raise UnreadableImage("is truncated")
    try:
        image = decode_png(data) if data.startswith(PNG) else None
    except ValueError as error:
        raise UnreadableImage(f"is damaged: {error}") from error
    if image is not None:
        return image
    at_once = data.startswith(JPEG) and header.channels == 3
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), RGB if at_once else cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise UnreadableImage("is damaged or of an unknown format")
    if image.ndim == 2 or at_once:
        return np.asarray(image)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))


def check_size(path: Path, image: NDArray[Any], width: int, height: int, reference: str, cure: str) -> None:
    """Raise DataError unless the image is width × height, as `reference` (who says so) wants it."""
    if image.shape[:2] != (height, width):
        raise DataError(str(path), f"is {image.shape[1]}×{image.shape[0]} while {reference} is {width}×{height}", cure)
