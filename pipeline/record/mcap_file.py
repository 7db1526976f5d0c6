"""Checked access to an MCAP file: in any order, from any thread, without believing what the file says of itself.

Every length and offset is compared with the bytes there are before anything of that size is read or allocated, and what a chunk may unpack to is
bounded by what its compression can do. Nothing but names, times and bytes comes out of here.
"""

from __future__ import annotations

import os
import struct
import threading
from collections import OrderedDict, defaultdict
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, ChunkIndex, Footer, Metadata, Schema, Statistics
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.record.mcap_chunks import LAST_TIME, MESSAGE_HEADER, ChunkPlace, Damaged, message_at, messages_in, records, unpack
from trihedron.pipeline.record.mcap_errors import damaged

MAGIC = b"\x89MCAP0\r\n"
FOOTER_BYTES = 9 + 20
CHUNK_HEADER = struct.Struct("<QQQII")  # first and last time, plain size, CRC, length of the compression's name
CHUNKS_KEPT = 6  # unpacked, so that neighbouring messages are not unpacked twice
_PARSING = (McapError, ValueError, struct.error, KeyError)
_Record = TypeVar("_Record")


@dataclass(frozen=True)
class ChannelIndex:
    """Where the messages of a channel lie, in the order they were written: (n,) log times in ns, file offsets of their chunks (-1: in none), and
    offsets of their records in the unpacked chunk (in none: in the file)."""

    channel: int
    log_times: NDArray[np.int64]
    chunks: NDArray[np.int64]
    offsets: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.log_times)


class McapFile:
    """An MCAP file opened for reading; `complete` is False where it ends before its end mark, and then what is whole of it can be read.

    Raises RecordingError when the file is missing or no MCAP file."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            self._file = open(self.path, "rb")
            self._size = os.fstat(self._file.fileno()).st_size
            head = self._bytes(0, min(len(MAGIC), self._size))
        except OSError as error:
            raise RecordingError(str(path), f"cannot be read: {error.strerror}", "give the path of an MCAP file") from error
        if head != MAGIC:
            raise damaged(path)
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.counts: dict[int, int] = {}  # channel -> messages, as the file says
        self.complete = self._size >= len(MAGIC) + FOOTER_BYTES and self._bytes(self._size - len(MAGIC), len(MAGIC)) == MAGIC
        self._indexes: list[ChunkIndex] = []
        self._scanned: dict[int, list[tuple[int, int, int]]] | None = None
        self._unpacked: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()
        if not (self.complete and self._read_summary()):
            self._scan()

    @property
    def indexed(self) -> bool:
        """Whether no message had to be searched for."""
        return not self._scanned

    def chunks(self, channel: int) -> list[ChunkIndex]:
        """The chunks that hold messages of a channel, in file order; of an indexed file whose chunks have indexes."""
        return [index for index in self._indexes if channel in index.message_index_offsets]

    def in_chunk(self, chunk: ChunkIndex, channel: int) -> list[tuple[int, bytes]]:
        """(log time, content) of a channel's messages in a chunk. Raises RecordingError where they are damaged."""
        try:
            rows = self._chunk_rows(chunk, channel)
            plain = self._plain(chunk.chunk_start_offset, self._chunk(chunk.chunk_start_offset)) if len(rows) else b""
            return [(log_time, message_at(plain, offset, channel)) for log_time, _, offset in rows.tolist()]
        except (Damaged, *_PARSING) as error:
            raise self._damaged(channel, error) from error

    def count_in_chunk(self, chunk: ChunkIndex, channel: int) -> int:
        """How many of a channel's messages are in a chunk, by its index alone. Raises RecordingError where that is damaged."""
        try:
            return len(self._chunk_rows(chunk, channel))
        except (Damaged, *_PARSING) as error:
            raise self._damaged(channel, error) from error

    def schema_name(self, channel: int) -> str:
        """The name of the type of a channel's messages, empty where none is given."""
        schema = self.schemas.get(self.channels[channel].schema_id)
        return schema.name if schema is not None else ""

    def locate(self, channel: int) -> ChannelIndex:
        """Where the messages of a channel lie. Raises RecordingError for a damaged index."""
        try:
            if self._scanned is not None:
                rows = np.array(self._scanned.get(channel, []), np.int64).reshape(-1, 3)
            else:
                rows = np.concatenate([np.empty((0, 3), np.int64), *(self._chunk_rows(index, channel) for index in self._indexes)])
        except (Damaged, *_PARSING) as error:
            raise self._damaged(channel, error) from error
        return ChannelIndex(channel, rows[:, 0], rows[:, 1], rows[:, 2])

    def read(self, index: ChannelIndex, row: int, most: int | None = None) -> bytes:
        """The bytes of one message; only the first `most` where that spares reading the others. Raises RecordingError where they are damaged."""
        chunk, offset = int(index.chunks[row]), int(index.offsets[row])
        try:
            if chunk < 0:
                return self._loose_message(index.channel, offset, self._size, most)
            place = self._chunk(chunk)
            if not place.compression and most is not None:
                return self._loose_message(index.channel, place.start + offset, place.start + place.packed, most)
            return message_at(self._plain(chunk, place), offset, index.channel)
        except (Damaged, *_PARSING) as error:
            raise self._damaged(index.channel, error) from error

    def _damaged(self, channel: int, error: Exception) -> RecordingError:
        topic = self.channels[channel].topic if channel in self.channels else f"number {channel}"
        cure = f"rescue what is whole with: trihedron recover {self.path}"
        return RecordingError(str(self.path), f"channel {topic} is damaged: {error or type(error).__name__}", cure)

    # bytes of the file

    def _bytes(self, start: int, length: int) -> bytes:
        if start < 0 or length < 0 or start + length > self._size:
            raise Damaged("an offset or a length leads out of the file")
        data = os.pread(self._file.fileno(), length, start)
        while len(data) < length:  # one call reads 2 GiB at most
            more = os.pread(self._file.fileno(), length - len(data), start + len(data))
            if not more:
                raise Damaged("the file became shorter")
            data += more
        return data

    def _record(self, at: int, stop: int) -> tuple[int, int, int]:
        """Opcode, begin and length of the content of the record at a file offset, which ends before `stop`."""
        opcode, length = struct.unpack("<BQ", self._bytes(at, 9))
        if at + 9 + length > stop:
            raise Damaged("a record is longer than what holds it")
        return opcode, at + 9, length

    def _parsed(self, kind: type[_Record], start: int, length: int) -> _Record:
        return _parse(kind, self._bytes(start, length))

    def _loose_message(self, channel: int, at: int, stop: int, most: int | None) -> bytes:
        opcode, start, length = self._record(at, stop)
        header = MESSAGE_HEADER.size
        if opcode != Opcode.MESSAGE or length < header or MESSAGE_HEADER.unpack(self._bytes(start, header))[0] != channel:
            raise Damaged("the index names a place where none of its messages is")
        content = length - header
        return self._bytes(start + header, content if most is None else min(content, most))

    # what the file holds

    def _read_summary(self) -> bool:
        """Take channels and indexes of chunks from the end of the file; whether they are there."""
        try:
            end = self._size - len(MAGIC) - FOOTER_BYTES
            opcode, start, length = self._record(end, self._size - len(MAGIC))
            at = self._parsed(Footer, start, length).summary_start
            if opcode != Opcode.FOOTER or not 0 < at <= end:
                return False
            while at < end:
                opcode, start, length = self._record(at, end)
                self._describe(opcode, start, length)
                at = start + length
        except (Damaged, *_PARSING):
            self._indexes = []
        self._indexes.sort(key=lambda index: index.chunk_start_offset)
        return bool(self.channels and self._indexes)

    def _describe(self, opcode: int, start: int, length: int) -> None:
        """Take in a record that says something of the file; others are passed over."""
        if opcode == Opcode.CHANNEL:
            channel = self._parsed(Channel, start, length)
            self.channels[channel.id] = channel
        elif opcode == Opcode.SCHEMA:
            schema = self._parsed(Schema, start, length)
            self.schemas[schema.id] = schema
        elif opcode == Opcode.CHUNK_INDEX:
            self._indexes.append(self._parsed(ChunkIndex, start, length))
        elif opcode == Opcode.METADATA:
            metadata = self._parsed(Metadata, start, length)
            self.metadata[metadata.name] = metadata.metadata
        elif opcode == Opcode.ATTACHMENT:
            attachment = self._parsed(Attachment, start, length)
            self.attachments[attachment.name] = attachment.data
        elif opcode == Opcode.STATISTICS:
            self.counts = dict(self._parsed(Statistics, start, length).channel_message_counts)
        elif opcode in (Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX):
            at = struct.unpack("<Q", self._bytes(start, 8))[0]
            opcode, start, length = self._record(at, self._size)
            if opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
                self._describe(opcode, start, length)

    def _scan(self) -> None:
        """Go through the file where it has no index, as far as it is whole."""
        self._scanned = defaultdict(list)
        at = len(MAGIC)
        while at < self._size:
            try:
                opcode, start, length = self._record(at, self._size)
                if opcode == Opcode.CHUNK:
                    self._scan_chunk(at)
                elif opcode == Opcode.MESSAGE and length >= MESSAGE_HEADER.size:
                    channel, _, log_time, _ = MESSAGE_HEADER.unpack(self._bytes(start, MESSAGE_HEADER.size))
                    self._scanned[channel].append((min(log_time, LAST_TIME), -1, at))
                elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
                    return
                else:
                    self._describe(opcode, start, length)
            except (Damaged, *_PARSING):
                self.complete = False
                return
            at = start + length
        self.complete = False

    def _scan_chunk(self, at: int) -> None:
        assert self._scanned is not None
        plain = self._plain(at, self._chunk(at))
        for channel, log_time, offset in messages_in(plain):
            self._scanned[channel].append((log_time, at, offset))
        for opcode, start, length in records(plain):
            if opcode == Opcode.CHANNEL:
                found = _parse(Channel, plain[start : start + length])
                self.channels[found.id] = found
            elif opcode == Opcode.SCHEMA:
                schema = _parse(Schema, plain[start : start + length])
                self.schemas[schema.id] = schema

    # chunks

    def _chunk_rows(self, index: ChunkIndex, channel: int) -> NDArray[np.int64]:
        """(n, 3) log time, chunk and offset of a channel's messages in one chunk."""
        if not index.message_index_offsets:  # none was written: the chunk itself says
            begin = index.chunk_start_offset
            found = [(log_time, begin, at) for named, log_time, at in messages_in(self._plain(begin, self._chunk(begin))) if named == channel]
            return np.array(found, np.int64).reshape(-1, 3)
        if channel not in index.message_index_offsets:
            return np.empty((0, 3), np.int64)
        opcode, start, length = self._record(index.message_index_offsets[channel], self._size)
        content = self._bytes(start, length)
        named, size = struct.unpack_from("<HI", content)
        if opcode != Opcode.MESSAGE_INDEX or named != channel or size % 16 or size != length - 6:
            raise Damaged("a chunk's index is not one")
        entries = np.frombuffer(content, "<u8", offset=6).reshape(-1, 2).astype(np.int64)
        return np.column_stack([entries[:, 0], np.full(len(entries), index.chunk_start_offset), entries[:, 1]])

    def _chunk(self, at: int) -> ChunkPlace:
        """The place of a chunk, its claims checked."""
        opcode, start, length = self._record(at, self._size)
        if opcode != Opcode.CHUNK:
            raise Damaged("the index names a chunk where none is")
        _, _, plain, crc, name_length = CHUNK_HEADER.unpack(self._bytes(start, CHUNK_HEADER.size))
        if name_length > length:
            raise Damaged("a name is longer than its record")
        name = self._bytes(start + CHUNK_HEADER.size, name_length).decode("utf-8", "replace")
        head = CHUNK_HEADER.size + name_length + 8
        (packed,) = struct.unpack("<Q", self._bytes(start + head - 8, 8))
        if head + packed > length:
            raise Damaged("a chunk is longer than its record")
        return ChunkPlace(start + head, packed, plain, crc, name)

    def _plain(self, at: int, chunk: ChunkPlace) -> bytes:
        """The unpacked bytes of a chunk, those of the last few kept."""
        with self._lock:
            if at in self._unpacked:
                self._unpacked.move_to_end(at)
                return self._unpacked[at]
        plain = unpack(self._bytes(chunk.start, chunk.packed), chunk)
        with self._lock:
            self._unpacked[at] = plain
            while len(self._unpacked) > CHUNKS_KEPT:
                self._unpacked.popitem(last=False)
        return plain


def _parse(kind: type[_Record], content: bytes) -> _Record:
    reader: Any = kind
    parsed: _Record = reader.read(ReadDataStream(BytesIO(content)))
    return parsed
