"""Pixels of a message's image as RGB or metres, checked against the bytes there are."""

from __future__ import annotations

import struct
from enum import Enum
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.readers.images import decode_image, metres
from trihedron.datasets.readers.picture_headers import UnreadableImage, picture_header
from trihedron.datasets.readers.robot_values import Picture
from trihedron.pipeline.core.types import F32, U8


class Kind(Enum):
    """Content of an image."""

    color = "colour"
    grey = "grey"
    depth = "depth"


COLORS: dict[str, tuple[int, int | None]] = {  # raw encoding -> channels, conversion to RGB
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
}
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}  # raw encoding -> element
CONFIG = struct.Struct("<iff")  # before the picture of a compressedDepth: format, and the two parameters of inverse depths
COMPRESSED_DEPTH = "compressedDepth"


def kind_of(picture: Picture) -> Kind | None:
    """Classify an image; None for an encoding that is not known. Raises UnreadableImage for a damaged compressed one."""
    if not picture.compressed:
        if picture.encoding in DEPTHS:
            return Kind.depth
        channels = COLORS.get(picture.encoding, (0, None))[0]
        return {0: None, 1: Kind.grey}.get(channels, Kind.color)
    if COMPRESSED_DEPTH in picture.encoding:
        return Kind.depth
    header = picture_header(picture.data)
    if header.bits == 16:
        return Kind.depth if header.channels == 1 else None
    return Kind.grey if header.channels == 1 else Kind.color


def color_of(picture: Picture) -> U8:
    """(h, w, 3) RGB. Raises UnreadableImage for what is damaged or no colour."""
    if picture.compressed:
        image = decode_image(picture.data)
        if image.dtype != np.uint8:
            raise UnreadableImage(f"has {8 * image.itemsize} bits a channel where colour has 8")
        channels = 1 if image.ndim == 2 else image.shape[2]
        code: int | None = {1: cv2.COLOR_GRAY2RGB, 3: None, 4: cv2.COLOR_RGBA2RGB}[channels]
    else:
        if picture.encoding not in COLORS:
            raise UnreadableImage(f"has the encoding '{picture.encoding[:40]}'; known for colour: {', '.join(COLORS)}")
        channels, code = COLORS[picture.encoding]
        image = _rows(picture, np.dtype(np.uint8), channels)
        image = image.reshape(*image.shape[:2], channels)
    return np.asarray(cv2.cvtColor(image, code) if code is not None else np.ascontiguousarray(image), np.uint8)


def depth_of(picture: Picture, depth_scale: float) -> F32:
    """(h, w) metres, 0 = none; 16-bit values are divided by `depth_scale`. Raises UnreadableImage for what is damaged or no depth."""
    if not picture.compressed:
        if picture.encoding not in DEPTHS:
            raise UnreadableImage(f"has the encoding '{picture.encoding[:40]}'; known for depth: {', '.join(DEPTHS)}")
        element = np.dtype((">" if picture.big_endian else "<") + DEPTHS[picture.encoding])
        return _metres(_rows(picture, element, 1)[..., 0], depth_scale)
    if COMPRESSED_DEPTH not in picture.encoding:
        return _metres(_sixteen_bits(picture.data), depth_scale)
    if len(picture.data) <= CONFIG.size:
        raise UnreadableImage("is cut off")
    values = _sixteen_bits(picture.data[CONFIG.size :])
    if not picture.encoding.startswith("32FC1"):
        return _metres(values, depth_scale)
    _, a, b = CONFIG.unpack_from(picture.data)
    with np.errstate(all="ignore"):  # compressed_depth_image_transport: value = a / z + b, 0 where there is none
        return _metres(np.where(values > 0, np.float32(a) / (values.astype(np.float32) - np.float32(b)), np.float32(0.0)), 1.0)


def _sixteen_bits(data: bytes) -> NDArray[Any]:
    image = decode_image(data)
    if image.ndim != 2 or image.dtype != np.uint16:
        raise UnreadableImage(f"has {8 * image.itemsize} bits a pixel where depth has 16 and one channel")
    return image


def _metres(values: NDArray[Any], depth_scale: float) -> F32:
    if values.dtype.kind == "f":
        return np.where(np.isfinite(values) & (values > 0), values, 0).astype(np.float32)
    return metres(values, depth_scale)


def _rows(picture: Picture, element: np.dtype[Any], channels: int) -> NDArray[Any]:
    """(h, w, channels) of a raw picture; a row may be longer than its pixels."""
    row = picture.width * channels * element.itemsize
    if not 0 < picture.width < 1 << 16 or not 0 < picture.height < 1 << 16 or picture.step < row:
        raise UnreadableImage(f"claims rows of {picture.step} bytes for {picture.width}×{picture.height} pixels '{picture.encoding}'")
    if len(picture.data) < picture.step * (picture.height - 1) + row:
        raise UnreadableImage(f"has {len(picture.data)} bytes for {picture.height} rows of {picture.step}")
    shape, strides = (picture.height, picture.width, channels), (picture.step, channels * element.itemsize, element.itemsize)
    return np.ndarray(shape, element, buffer=picture.data, strides=strides)
