"""PNG by imagecodecs, and where that is not installed (`requirements-minimal.txt`) by OpenCV and zlib, which take half as long again."""

from __future__ import annotations

import zlib
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import U8

HAS_IMAGECODECS = find_spec("imagecodecs") is not None
LEVEL = 1  # of the compression

if HAS_IMAGECODECS:
    from imagecodecs import deflate_encode, png_decode


def decode_png(data: bytes, channels: int) -> NDArray[Any]:
    """Decode an image of so many channels, as its header states: (h, w), (h, w, 3) RGB or (h, w, 4) RGBA of its own precision. A grey value that
    counts as transparent stays a value. Raises an exception of the library, or ValueError, for a damaged file."""
    if not HAS_IMAGECODECS:
        return _by_opencv(data, channels)
    image = np.asarray(png_decode(data))
    if image.ndim == 3 and image.shape[2] == 2:  # grey with opacity, or with one value that counts as transparent
        return image[..., [0, 0, 0, 1]] if channels == 2 else image[..., 0]
    return image


def _by_opencv(data: bytes, channels: int) -> NDArray[Any]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("OpenCV cannot decode it")
    if image.ndim == 2 or channels == 1:
        return np.asarray(image if image.ndim == 2 else image[..., 0])
    return in_rgb(image)


def in_rgb(image: NDArray[Any]) -> NDArray[Any]:
    """Turn the channels of a BGR or BGRA image of OpenCV round."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB if image.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))


def pack(rows: U8) -> bytes:
    """Compress the filtered rows of an image, as a zlib stream; the bytes are those of the library that is installed, on every processor."""
    return bytes(deflate_encode(rows.tobytes(), level=LEVEL)) if HAS_IMAGECODECS else zlib.compress(rows.tobytes(), LEVEL)
