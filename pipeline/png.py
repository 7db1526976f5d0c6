"""Whether the bytes of a PNG hold what its chunks claim: a decoder allocates a chunk's length before it reads it."""

from __future__ import annotations

import struct

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
HEADER = struct.pack(">I4s", 13, b"IHDR")


def is_whole_png(data: bytes) -> bool:
    """Whether these are the chunks of a PNG, the header first, none longer than the bytes left, up to the end mark."""
    if not data.startswith(PNG_MAGIC + HEADER):
        return False
    at = len(PNG_MAGIC)
    while at + 12 <= len(data):
        length, name = struct.unpack_from(">I4s", data, at)
        at += 12 + length
        if name == b"IEND":
            return bool(at <= len(data))
    return False
