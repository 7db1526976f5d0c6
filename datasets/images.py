"""Image files -> RGB and metres, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.errors import DataError
from trihedron.pipeline.types import F32, U8

# the end of a complete file; a decoder would fill the rest of a truncated JPEG with grey and say nothing
END_MARKS = {b"\x89PNG": b"IEND", b"\xff\xd8\xff": b"\xff\xd9"}
TAIL = 64  # bytes searched for the end mark: writers may pad


class UnreadableImage(Exception):
    """A file that cannot be opened or decoded; the message says why."""


def read_color(path: Path) -> U8:
    """(h, w, 3) RGB. Raises UnreadableImage for a missing or damaged file, DataError for an image that is not 8-bit colour."""
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint8:
        cause = f"has {8 * image.itemsize} bits a channel where colour has 8"
        raise DataError(str(path), cause, "give 8-bit RGB images; are colour and depth swapped?")
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise DataError(str(path), f"has {channels} channel{'s' * (channels != 1)} where colour has 3", "convert it to an RGB image")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGB), dtype=np.uint8)


def read_depth(path: Path, depth_scale: float, depth_offset: float = 0.0) -> F32:
    """(h, w) metres, 0 = none, from a 16-bit image whose value divided by `depth_scale` is metres z, corrected to 1 / (1 / z + `depth_offset`).

    Raises UnreadableImage for a missing or damaged file, DataError for an image that is not 16-bit with one channel."""
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2:
        raise DataError(str(path), f"has {image.shape[2]} channels where depth has 1", "give 16-bit depth images with one channel")
    if image.dtype != np.uint16:
        cure = "give 16-bit depth images (value = metres × depth_scale); a preview picture does not hold metres"
        raise DataError(str(path), f"has {8 * image.itemsize} bits a pixel where depth has 16", cure)
    depth = image.astype(np.float32) / np.float32(depth_scale)
    return depth / np.maximum(1.0 + np.float32(depth_offset) * depth, np.float32(0.1)) if depth_offset else depth


def _decode(path: Path, flags: int) -> NDArray[Any]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnreadableImage(f"cannot be opened ({error.strerror})") from error
    if not data:
        raise UnreadableImage("is empty")
    for magic, end in END_MARKS.items():
        if data.startswith(magic) and end not in data[-TAIL:]:
            raise UnreadableImage("is truncated")
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise UnreadableImage("is damaged or of an unknown format")
    return np.asarray(image)


def check_size(path: Path, image: NDArray[Any], width: int, height: int, reference: str, cure: str) -> None:
    """Raise DataError unless the image is width × height, as `reference` (who says so) wants it."""
    if image.shape[:2] != (height, width):
        raise DataError(str(path), f"is {image.shape[1]}×{image.shape[0]} while {reference} is {width}×{height}", cure)
