"""Image files as RGB and metres, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.readers.picture_headers import JPEG, PNG, UnreadableImage, picture_header, png_pixels
from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.core.files import SHOWN, read_file
from trihedron.pipeline.core.png_codec import decode_png, in_rgb
from trihedron.pipeline.core.types import F32, U8, Camera

RGB = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
JPEG_END = b"\xff\xd9"  # of a complete file; a decoder would fill the rest of a truncated one with grey, without an error
PIXELS_PER_BYTE = 2048  # more than a picture can pack: deflate makes 1032 bytes of one, a grey JPEG 512 pixels of one
MAX_PIXELS = 1 << 26  # more than any depth camera has
MAX_BYTES = 1 << 26  # of an image file
TAIL = 64  # bytes searched for the end mark: writers may pad


def read_color(path: Path) -> U8:
    """(h, w, 3) RGB. Raises UnreadableImage for a missing or damaged file, DataError for an image that is not 8-bit colour."""
    return _rgb(_decode(path), str(path))


def color_of(data: bytes, place: str) -> U8:
    """`read_color` of the bytes of a file."""
    return _rgb(decode_image(data), place)


def read_levels(path: Path) -> U8:
    """(h, w) whole numbers of an 8-bit image with one channel. Raises UnreadableImage for a missing or damaged file, DataError for another image."""
    image = _decode(path)
    if image.ndim != 2 or image.dtype != np.uint8:
        raise DataError(str(path), "is not an 8-bit image with one channel", "give it as the camera wrote it")
    return np.asarray(image, dtype=np.uint8)


def _rgb(image: NDArray[Any], place: str) -> U8:
    if image.dtype != np.uint8:
        cause = f"has {8 * image.itemsize} bits a channel where colour has 8"
        raise DataError(place, cause, "give 8-bit RGB images; are colour and depth swapped?")
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise DataError(place, f"has {channels} channel{'s' * (channels != 1)} where colour has 3", "convert it to an RGB image")
    return np.asarray(image if image.shape[2] == 3 else cv2.cvtColor(image, cv2.COLOR_RGBA2RGB), dtype=np.uint8)


def read_depth(path: Path, depth_scale: float) -> F32:
    """(h, w) metres, 0 = none, from a 16-bit image whose value divided by `depth_scale` is metres z.

    Raises UnreadableImage for a missing or damaged file, DataError for an image that is not 16-bit with one channel."""
    image = _decode(path)
    if image.ndim != 2:
        raise DataError(str(path), f"has {image.shape[2]} channels where depth has 1", "give 16-bit depth images with one channel")
    if image.dtype != np.uint16:
        cure = "give 16-bit depth images (value = metres × depth_scale); a preview picture does not hold metres"
        raise DataError(str(path), f"has {8 * image.itemsize} bits a pixel where depth has 16", cure)
    return metres(image, depth_scale)


def metres(values: NDArray[Any], depth_scale: float) -> F32:
    """Divide whole numbers by `depth_scale`: (h, w) float32."""
    depth: F32 = values.astype(np.float32)
    depth /= np.float32(depth_scale)
    return depth


def _decode(path: Path) -> NDArray[Any]:
    try:
        data = read_file(path, MAX_BYTES)
    except OSError as error:
        raise UnreadableImage(f"cannot be opened ({error.strerror})") from error
    if not data:
        raise UnreadableImage("is empty")
    return decode_image(data)


def decode_image(data: bytes) -> NDArray[Any]:
    """Decode an image: (h, w), (h, w, 3) RGB or (h, w, 4) RGBA. Raises UnreadableImage for another format (see `picture_headers`) and for
    what is cut off, damaged or larger than its bytes can hold."""
    header = picture_header(data)
    if header.cells > min(PIXELS_PER_BYTE * len(data), MAX_PIXELS):
        raise UnreadableImage(f"claims {header.width}×{header.height} pixels in {len(data)} bytes")
    pixels = png_pixels(data) if data.startswith(PNG) else None
    if (data.startswith(PNG) and pixels is None) or (data.startswith(JPEG) and JPEG_END not in data[-TAIL:]):
        raise UnreadableImage("is truncated")
    try:
        image = decode_png(pixels, header.channels) if pixels is not None else _decode_opencv(data, header.channels)
    except Exception as error:  # the decoders' own, and UnicodeDecodeError where libpng quotes a damaged name
        raise UnreadableImage(f"is damaged ({printable(str(error), SHOWN)})") from error
    if image is None or image.shape[:2] != (header.height, header.width):
        raise UnreadableImage("is damaged or of an unknown format")
    return image


def _decode_opencv(data: bytes, channels: int) -> NDArray[Any] | None:
    is_rgb = data.startswith(JPEG) and channels == 3
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), RGB if is_rgb else cv2.IMREAD_UNCHANGED)
    if image is None:
        return None
    if image.ndim == 2 or is_rgb:
        return np.asarray(image)
    return in_rgb(image)


def check_size(path: Path, image: NDArray[Any], width: int, height: int, reference: str, cure: str) -> None:
    """Raise DataError unless the image is width × height, the size of `reference`."""
    if image.shape[:2] != (height, width):
        raise DataError(str(path), f"is {image.shape[1]}×{image.shape[0]} while {reference} is {width}×{height}", cure)


def check_camera(path: Path, color: U8, camera: Camera) -> None:
    """Raise DataError unless a colour image has the size of the camera."""
    check_size(path, color, camera.width, camera.height, "the camera", "give the dataset.camera of these images")
