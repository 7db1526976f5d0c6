"""The records of an MCAP file, in the order they stand in it: chunks are put together and packed at once, since a run closes one of some hundred
messages twice a second."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Sequence
from typing import Any

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from zlib_ng import zlib_ng

WINDOW_LOG = 22  # a whole chunk is searched for repeats
QUICK = {"level": -3, "hash_log": 15}  # of zstd: numbers that repeat nothing stay as they are; the table leaves the cache of a processor to the run
THOROUGH = {"level": 2, "hash_log": 17, "min_match": 5, "target_length": 1}  # twice the time for a tenth less bytes
LARGE_BYTES = 200_000  # a frame: where as much comes, as on a walk where all is new, it is packed thoroughly
ZSTD = b"zstd"
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_CHUNK = struct.Struct(f"<BQQQQII{len(ZSTD)}sQ")  # opcode, length, first and last time, plain size, CRC, length of the name, name, packed size
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes of its entries
_RECORD_HEAD = 9  # bytes of opcode and length


def _compressor(level: int, **options: int) -> Any:
    return zstandard.ZstdCompressor(compression_params=zstandard.ZstdCompressionParameters.from_level(level, window_log=WINDOW_LOG, **options))


class McapWriter:
    """Writes to `file`, which has `write` and `tell`. Raises what these raise."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._undeclared: list[McapRecord] = []  # schemas and channels that the next chunk begins with
        self._chunks = bytearray()  # their records in the summary: as objects those of a long run would be ten times as large
        self._chunk_count = 0
        self._times: tuple[int, ...] = ()  # of the first message and of the last
        self._metadata: list[MetadataIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._counts: Counter[int] = Counter()
        self._quick, self._thorough = _compressor(**QUICK), _compressor(**THOROUGH)

    def start(self, library: str) -> None:
        """The beginning of the file."""
        self._file.write(MCAP0_MAGIC + _bytes_of(Header("", library)))

    def metadata(self, name: str, content: dict[str, str]) -> None:
        """A metadata record."""
        at, data = self._file.tell(), _bytes_of(Metadata(name, content))
        self._file.write(data)
        self._metadata.append(MetadataIndex(at, len(data), name))

    def attachment(self, name: str, media_type: str, content: bytes) -> None:
        """An attachment without times."""
        at, data = self._file.tell(), _bytes_of(Attachment(0, 0, name, media_type, content))
        self._file.write(data)
        self._attachments.append(AttachmentIndex(at, len(data), 0, 0, len(content), name, media_type))

    def channel(self, topic: str, schema: str, encoding: str, definition: bytes, message_encoding: str) -> int:
        """Declare a channel with a schema of its own, in the next chunk; returns its number."""
        number = len(self._channels) + 1
        self._schemas.append(Schema(number, definition, encoding, schema))
        self._channels.append(Channel(number, topic, message_encoding, {}, number))
        self._undeclared += [self._schemas[-1], self._channels[-1]]
        return number

    def chunk(self, messages: Sequence[tuple[int, int, bytes]]) -> None:
        """A chunk of these messages (channel, log time in ns, content), at least one, and its index."""
        parts, at = [_bytes_of(*self._undeclared)], 0
        at += len(parts[0])
        entries: dict[int, list[int]] = {}
        for channel, stamp_ns, data in messages:
            entries.setdefault(channel, []).extend((stamp_ns, at))
            head = _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE.size - _RECORD_HEAD + len(data), channel, 0, stamp_ns, stamp_ns)
            parts += (head, data)
            at += _MESSAGE.size + len(data)
        plain = b"".join(parts)
        stamps = {stamp_ns for _, stamp_ns, _ in messages}
        packed = (self._thorough if len(plain) > LARGE_BYTES * len(stamps) else self._quick).compress(plain)
        times = min(stamps), max(stamps)
        length = _CHUNK.size - _RECORD_HEAD + len(packed)
        head = _CHUNK.pack(Opcode.CHUNK, length, *times, len(plain), zlib_ng.crc32(plain), len(ZSTD), ZSTD, len(packed))
        begin, size = self._file.tell(), _RECORD_HEAD + length
        indexes, offsets = [], {}
        end = begin + size
        for channel, pairs in entries.items():
            offsets[channel] = end
            indexes.append(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + 8 * len(pairs), channel, 8 * len(pairs)) + struct.pack(f"<{len(pairs)}Q", *pairs))
            end += len(indexes[-1])
            self._counts[channel] += len(pairs) // 2
        self._file.write(b"".join([head, packed, *indexes]))
        self._undeclared = []
        self._chunks += _bytes_of(ChunkIndex(size, begin, ZSTD.decode(), len(packed), times[1], end - begin - size, offsets, times[0], len(plain)))
        self._chunk_count += 1
        self._times = min(*self._times, *times), max(*self._times, *times)

    def finish(self) -> None:
        """The summary and the end mark."""
        self._file.write(_bytes_of(DataEnd(0)))
        begin, at = self._file.tell(), 0
        groups: list[tuple[int, bytes | bytearray]] = [
            (Opcode.SCHEMA, _bytes_of(*self._schemas)),
            (Opcode.CHANNEL, _bytes_of(*self._channels)),
            (Opcode.STATISTICS, _bytes_of(self._statistics())),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, _bytes_of(*self._attachments)),
            (Opcode.METADATA_INDEX, _bytes_of(*self._metadata)),
        ]
        offsets = []
        for opcode, records in groups:
            if records:
                offsets.append(SummaryOffset(opcode, begin + at, len(records)))
                at += len(records)
        summary = b"".join(records for _, records in groups) + _bytes_of(*offsets)
        footer = _bytes_of(Footer(begin, begin + at, 0))
        crc = zlib_ng.crc32(footer[:-4], zlib_ng.crc32(summary))
        self._file.write(summary + footer[:-4] + struct.pack("<I", crc) + MCAP0_MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=self._chunk_count,
            message_count=self._counts.total(),
            message_end_time=max(self._times, default=0),
            message_start_time=min(self._times, default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    end: Any = builder.end
    return bytes(end())
