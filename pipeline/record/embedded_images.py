"""Embedded images as messages that any tool shows: colour as `foxglove.CompressedImage` (PNG), depth as `foxglove.RawImage` (32FC1, metres).

A frame of topic T is on the channels `/T/color` and `/T/depth`; its number and camera are in the topic `frames`. The PNG has the filter "up" in every
row, which is the difference of each row to the one above, so that nothing is searched for; its bytes are the same on every processor.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp

from trihedron.pipeline.core.errors import RecordingError, printable
from trihedron.pipeline.core.png_codec import decode_png, pack
from trihedron.pipeline.core.types import F32, U8, Frame, FrameReference
from trihedron.pipeline.record.mcap_file import max_plain_bytes

COLOR, DEPTH = "/color", "/depth"  # behind the name of the topic
PARTS: dict[str, Any] = {COLOR: CompressedImage, DEPTH: RawImage}
CAMERA = "camera"  # frame_id
DEPTH_ENCODING = "32FC1"
PNG = b"\x89PNG\r\n\x1a\n"
UP = 2  # the filter of a row
DAMAGED = "the file is damaged; record it again"
_HEADER = struct.Struct(">II5B")  # width, height, bits, colour type (2: RGB), compression, filters, interlacing


def topic_of(channel: str) -> str:
    """Return the topic of a channel (with slash), to which those of its images belong."""
    return channel.removesuffix(COLOR).removesuffix(DEPTH)[1:]


def messages_of(frame: Frame) -> Iterator[tuple[str, CompressedImage | RawImage]]:
    """Make the messages of a frame, each with the end of its channel's name."""
    stamp = Timestamp(seconds=frame.stamp_ns // 1_000_000_000, nanos=frame.stamp_ns % 1_000_000_000)
    yield COLOR, CompressedImage(timestamp=stamp, frame_id=CAMERA, format="png", data=png(frame.color))
    height, width = frame.depth_m.shape
    data = np.ascontiguousarray(frame.depth_m, "<f4").tobytes()
    yield DEPTH, RawImage(timestamp=stamp, frame_id=CAMERA, width=width, height=height, encoding=DEPTH_ENCODING, step=4 * width, data=data)


def frame_of(reference: FrameReference, color: bytes, depth: bytes, place: str) -> Frame:
    """Read the images of a frame, bit for bit. Raises RecordingError, beginning with `place`, where they are damaged."""
    try:
        compressed, raw = CompressedImage.FromString(color), RawImage.FromString(depth)
        return Frame(reference.index, reference.stamp_ns, _color(compressed), _depth(raw), reference.camera)
    except Exception as error:  # a stranger's file
        cause = printable(f"frame {reference.index}: an image cannot be read: {error}", 200)
        raise RecordingError(place, cause, DAMAGED) from error


def png(image: U8) -> bytes:
    """Encode an image (h, w, 3) RGB."""
    height, width = image.shape[:2]
    flat = image.reshape(height, 3 * width)
    rows = np.empty((height, 3 * width + 1), np.uint8)
    rows[:, 0] = UP
    rows[0, 1:] = flat[0]
    np.subtract(flat[1:], flat[:-1], out=rows[1:, 1:])
    return PNG + _chunk(b"IHDR", _HEADER.pack(width, height, 8, 2, 0, 0, 0)) + _chunk(b"IDAT", pack(rows)) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(content, zlib.crc32(kind)))


def _color(message: Any) -> U8:
    """The pixels of a PNG, which claims no more of them than its bytes may hold. Raises ValueError."""
    width, height, *kind = _HEADER.unpack_from(message.data, len(PNG) + 8)
    if not message.data.startswith(PNG) or kind != [8, 2, 0, 0, 0] or 3 * width * height > max_plain_bytes(len(message.data)):
        raise ValueError("it is no PNG of three channels and eight bits")
    return np.asarray(decode_png(message.data, 3), np.uint8).reshape(height, width, 3)


def _depth(message: Any) -> F32:
    """The readings of a raw image. Raises ValueError."""
    if message.encoding != DEPTH_ENCODING or message.step != 4 * message.width:
        raise ValueError(f"its encoding is '{message.encoding}', not {DEPTH_ENCODING}")
    return np.frombuffer(message.data, "<f4").reshape(message.height, message.width)
