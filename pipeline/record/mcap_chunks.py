"""The chunks of an MCAP file: what one claims to be, unpacked within the bounds of its compression, and the records in it."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import lz4.frame
import zstandard
from mcap.opcode import Opcode

MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
LAST_TIME = 2**63 - 1  # what fits into 64 bits with a sign
MAX_PLAIN_BYTES = 1 << 30  # of one chunk
MAX_RATIO = {"": 1, "lz4": 255, "zstd": 1 << 15}  # of plain to packed bytes, by the format (zstd: a block of 128 KiB takes 4 bytes)


class Damaged(Exception):
    """Bytes that contradict each other; the message says which."""


@dataclass(frozen=True)
class ChunkPlace:
    """Where the packed bytes of a chunk lie in the file, and what they unpack to. Raises Damaged for what its compression cannot do."""

    start: int
    packed: int
    plain: int
    crc: int
    compression: str

    def __post_init__(self) -> None:
        if self.compression not in MAX_RATIO:
            raise Damaged(f"the compression '{self.compression[:20]}' is not known")
        if self.plain > min(MAX_PLAIN_BYTES, MAX_RATIO[self.compression] * self.packed + 64) or (not self.compression and self.plain != self.packed):
            raise Damaged(f"a chunk of {self.packed} bytes claims to hold {self.plain}")


def unpack(packed: bytes, chunk: ChunkPlace) -> bytes:
    """The plain bytes, of the length and the CRC that the chunk says. Raises Damaged otherwise."""
    try:
        if chunk.compression == "zstd":
            said = zstandard.get_frame_parameters(packed).content_size
            if said not in (chunk.plain, zstandard.CONTENTSIZE_UNKNOWN):
                raise Damaged("a chunk and what it packs differ in size")
            plain = zstandard.ZstdDecompressor().decompress(packed, max_output_size=max(chunk.plain, 1))
        elif chunk.compression == "lz4":
            plain = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=chunk.plain + 1)
        else:
            plain = packed
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise Damaged("a chunk cannot be unpacked") from error
    if len(plain) != chunk.plain or (chunk.crc and zlib.crc32(plain) != chunk.crc):
        raise Damaged("a chunk does not hold what was written")
    return bytes(plain)


def records(plain: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, begin and length of the content of each record in a chunk. Raises Damaged where one is cut off."""
    at = 0
    while at < len(plain):
        if at + 9 > len(plain):
            raise Damaged("a record in a chunk is cut off")
        opcode, length = struct.unpack_from("<BQ", plain, at)
        if at + 9 + length > len(plain):
            raise Damaged("a record in a chunk is cut off")
        yield opcode, at + 9, length
        at += 9 + length


def message_at(plain: bytes, at: int, channel: int) -> bytes:
    """The content of the message of a channel whose record begins at an offset of a chunk. Raises Damaged where none is."""
    if at < 0 or at + 9 + MESSAGE_HEADER.size > len(plain):
        raise Damaged("an offset leads out of its chunk")
    opcode, length = struct.unpack_from("<BQ", plain, at)
    if opcode != Opcode.MESSAGE or length < MESSAGE_HEADER.size or at + 9 + length > len(plain):
        raise Damaged("the index names a place where no message is")
    if MESSAGE_HEADER.unpack_from(plain, at + 9)[0] != channel:
        raise Damaged("the index names another channel's message")
    return plain[at + 9 + MESSAGE_HEADER.size : at + 9 + length]


def messages_in(plain: bytes) -> Iterator[tuple[int, int, int]]:
    """Channel, log time and offset of each message in a chunk."""
    for opcode, start, length in records(plain):
        if opcode == Opcode.MESSAGE and length >= MESSAGE_HEADER.size:
            channel, _, log_time, _ = MESSAGE_HEADER.unpack_from(plain, start)
            yield channel, min(log_time, LAST_TIME), start - 9
