"""Whether the bytes of a PNG hold what its chunks claim: a decoder allocates a chunk's length before it reads it."""

from __future__ import annotations

import struct
from collections.abc import Iterator

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
CHECKSUM = 4  # bytes after a chunk's content
HEADER = struct.pack(">I4s", 13, b"IHDR")


def chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """The name of each chunk of a PNG, and where its content begins and ends. The last may claim an end beyond the bytes there are."""
    at = len(PNG_MAGIC)
    while at + 12 <= len(data):
        length, name = struct.unpack_from(">I4s", data, at)
        yield name, at + 8, at + 8 + length
        at += 12 + length


def is_whole_png(data: bytes) -> bool:
    """Whether these are the chunks of a PNG, the header first, none longer than the bytes left, up to the end mark."""
    headed = data.startswith(PNG_MAGIC + HEADER)
    return headed and any(name == b"IEND" and end + CHECKSUM <= len(data) for name, _, end in chunks(data))
