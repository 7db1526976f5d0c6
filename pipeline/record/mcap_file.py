"""Read an MCAP file in any order and from any thread, within bounds, with the `mcap` package.

The package parses records. This module is its boundary: it bounds the sizes that a file may claim, and turns whatever the package raises into one
RecordingError. Two steps are not in the package's public interface and stand here: to unpack a chunk to at most a given size, and to read one
message at the offset that a message index gives.
"""

from __future__ import annotations

import fcntl
import os
import struct
import threading
import zlib
from collections import OrderedDict, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import SEEK_END, BytesIO
from pathlib import Path
from typing import IO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, ChunkIndex, DataEnd, McapRecord, Message, MessageIndex, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import RecordingError, printable
from trihedron.pipeline.core.files import open_file

RECORDING = "run.mcap"  # in the folder of a run
FOOTER_BYTES = 9 + 20 + len(MCAP0_MAGIC)  # of the footer and the end mark
MAX_INDEX_BYTES = 64 << 20  # of the summary at the end of the file
MAX_CHUNK_BYTES = 1 << 30  # of one chunk, unpacked
FREE_BYTES, MAX_RATIO = 64 << 20, 64  # what a few packed bytes may unpack to, and what each further one adds
FREE_MESSAGES, ENTRY_BYTES = 200_000, 16  # messages of a file without an index: so many, and one for each so many bytes
MAX_TIME = 2**63 - 1  # ns
CACHED_CHUNKS = 6  # unpacked, so that neighbouring messages do not unpack them again
RECORD_HEAD = struct.Struct("<BQ")  # opcode and length
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


def max_plain_bytes(packed: int) -> int:
    """Return the most bytes that so many packed ones may claim to unpack to."""
    return FREE_BYTES + MAX_RATIO * packed


@dataclass(frozen=True)
class ChannelIndex:
    """Places of the messages of a channel, in the order of the file: (n,) log times in ns, file offsets of their chunks (-1: in none), and offsets
    of their records in the unpacked chunk (in none: in the file)."""

    channel: int
    log_times: NDArray[np.int64]
    chunks: NDArray[np.int64]
    offsets: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.log_times)


def recording_file(path: Path | str) -> Path:
    """Return the recording of the folder of a run, or the file itself."""
    given = Path(path)
    return given / RECORDING if given.is_dir() else given


class McapFile:
    """An MCAP file opened for reading, of a run folder its recording; `complete` is False where it ends before its end mark: then its whole records
    can be read.

    Raises RecordingError when the file is missing or no MCAP file."""

    def __init__(self, path: Path | str) -> None:
        self.path = recording_file(path)
        try:
            self._file = open_file(self.path)
            self._size = os.fstat(self._file.fileno()).st_size
        except OSError as error:
            raise RecordingError(str(self.path), f"cannot be read: {error.strerror}", "give the path of an MCAP file") from error
        if not self._size or self._bytes(0, min(len(MCAP0_MAGIC), self._size)) != MCAP0_MAGIC:
            raise damaged_file_error(self.path)
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.counts: dict[int, int] = {}  # channel -> messages, as the file claims
        self._indexes: dict[int, ChunkIndex] = {}  # by file offset, in order
        self._scanned: dict[int, list[tuple[int, int, int]]] | None = None
        self._unpacked: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()
        end = self._bytes(max(self._size - len(MCAP0_MAGIC), 0), min(len(MCAP0_MAGIC), self._size))
        self.complete = self._size >= len(MCAP0_MAGIC) + FOOTER_BYTES and end == MCAP0_MAGIC
        if not (self.complete and self._read_summary()):
            self._scan()

    @property
    def indexed(self) -> bool:
        """True where the file has an index, so that no message had to be searched for."""
        return not self._scanned

    def chunks(self, channel: int) -> list[ChunkIndex]:
        """Return the chunks that hold messages of a channel, in file order; of an indexed file."""
        return [index for index in self._indexes.values() if channel in index.message_index_offsets or not index.message_index_offsets]

    def in_chunk(self, chunk: ChunkIndex, channel: int) -> list[tuple[int, bytes]]:
        """Read (log time, content) of a channel's messages in a chunk. Raises RecordingError where they are damaged."""
        with self._reading(channel):
            entries, found, total = self._entries(chunk, channel), [], 0
            plain = self._plain(chunk.chunk_start_offset) if len(entries) else b""
            for log_time, _, offset in entries.tolist():
                found.append((log_time, _content(plain, offset, channel, log_time)))
                _check_total(total := total + len(found[-1][1]), len(plain))
            return found

    def count_in_chunk(self, chunk: ChunkIndex, channel: int) -> int:
        """Count a channel's messages in a chunk by its index alone. Raises RecordingError where that is damaged."""
        with self._reading(channel):
            return len(self._entries(chunk, channel))

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Read (channel, log time, content) of all messages, chunk by chunk. Raises RecordingError where they are damaged."""
        for chunk in self._indexes.values():
            for channel in chunk.message_index_offsets or self.channels:
                for log_time, data in self.in_chunk(chunk, channel):
                    yield channel, log_time, data
        for channel in self._scanned or ():
            index = self.locate(channel)
            for row in range(len(index)):
                yield channel, int(index.log_times[row]), self.read(index, row)

    def schema_name(self, channel: int) -> str:
        """Return the type of a channel's messages, empty where none is given."""
        schema = self.schemas.get(self.channels[channel].schema_id)
        return schema.name if schema is not None else ""

    def locate(self, channel: int) -> ChannelIndex:
        """Find where the messages of a channel lie. Raises RecordingError for a damaged index."""
        with self._reading(channel):
            if self._scanned is not None:
                rows = np.array(self._scanned.get(channel, []), np.int64).reshape(-1, 3)
            else:
                rows = np.concatenate([np.empty((0, 3), np.int64), *(self._entries(index, channel) for index in self._indexes.values())])
            return ChannelIndex(channel, rows[:, 0], rows[:, 1], rows[:, 2])

    def read(self, index: ChannelIndex, row: int, most: int | None = None) -> bytes:
        """Read one message; only its first `most` bytes where that spares reading the others. Raises RecordingError where it is damaged."""
        chunk, offset, log_time = int(index.chunks[row]), int(index.offsets[row]), int(index.log_times[row])
        with self._reading(index.channel):
            if chunk < 0:
                return self._content_in_file(index.channel, offset, most)
            place = self._indexes.get(chunk)
            if most is not None and place is not None and not place.compression:  # its bytes are the last of its record
                return self._content_in_file(index.channel, chunk + place.chunk_length - place.uncompressed_size + offset, most)
            return _content(self._plain(chunk), offset, index.channel, log_time)

    @contextmanager
    def _reading(self, channel: int) -> Iterator[None]:
        """Turn any error inside the block into a RecordingError that names the channel."""
        try:
            yield
        except Exception as error:
            topic = printable(self.channels[channel].topic, 80) if channel in self.channels else f"number {channel}"
            cause = printable(str(error), 120) or type(error).__name__
            cure = f"rescue what is whole with: trihedron recover {self.path}"
            raise RecordingError(str(self.path), f"channel {topic} is damaged: {cause}", cure) from error

    # bytes and records of the file

    def _bytes(self, start: int, length: int) -> bytes:
        if start < 0 or length < 0 or start + length > self._size:
            raise ValueError("an offset or a length leads out of the file")
        parts = []
        while length:
            part = os.pread(self._file.fileno(), length, start)  # one call reads 2 GiB at most
            if not part:
                raise ValueError("the file became shorter")
            parts.append(part)
            start, length = start + len(part), length - len(part)
        return b"".join(parts)

    def _record(self, at: int, opcode: int) -> bytes:
        """Read the content of the record of this kind at an offset."""
        found, length = RECORD_HEAD.unpack(self._bytes(at, RECORD_HEAD.size))
        if found != opcode:
            raise ValueError("the index names a place where none of its records is")
        return self._bytes(at + RECORD_HEAD.size, length)

    def _content_in_file(self, channel: int, at: int, most: int | None) -> bytes:
        """Read the content of an unpacked message at a file offset."""
        opcode, length = RECORD_HEAD.unpack(self._bytes(at, RECORD_HEAD.size))
        at += RECORD_HEAD.size
        if opcode != Opcode.MESSAGE or length < MESSAGE_HEAD.size or MESSAGE_HEAD.unpack(self._bytes(at, MESSAGE_HEAD.size))[0] != channel:
            raise ValueError("the index names a place where none of its messages is")
        content = length - MESSAGE_HEAD.size
        if at + length > self._size:
            raise ValueError("a message is longer than the file")
        return self._bytes(at + MESSAGE_HEAD.size, content if most is None else min(content, most))

    # what the file holds

    def _read_summary(self) -> bool:
        """Take channels and indexes from the end of the file; returns False where they are missing or contradict each other."""
        try:
            start = struct.unpack_from("<Q", self._record(self._size - FOOTER_BYTES, Opcode.FOOTER))[0]
            _check_total(self._size - start if start else 0, MAX_INDEX_BYTES)
            reader = SeekingReader(self._file, record_size_limit=self._size)
            summary = reader.get_summary()
            if summary is None or not summary.channels or not summary.chunk_indexes:
                return False
            self._take(summary)
            total = 0
            for metadata in reader.iter_metadata():
                self.metadata[metadata.name] = metadata.metadata
                _check_total(total := total + sum(len(key) + len(text) for key, text in metadata.metadata.items()), self._size)
            for attachment in reader.iter_attachments():
                self.attachments[attachment.name] = attachment.data
                _check_total(total := total + len(attachment.data), self._size)
        except Exception:
            self.metadata, self.attachments, self._indexes = {}, {}, {}
            return False
        return True

    def _take(self, summary: Summary) -> None:
        """Keep a summary. Raises ValueError where its chunks overlap, or claim to hold more than they can."""
        indexes, end = sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset), 0
        for index in indexes:
            if index.chunk_start_offset < end:
                raise ValueError("its chunks overlap")
            end = index.chunk_start_offset + index.chunk_length + index.message_index_length
        _check_total(end, self._size)
        _check_total(sum(index.uncompressed_size for index in indexes), max_plain_bytes(self._size))
        self.channels, self.schemas = summary.channels, summary.schemas
        self._indexes = {index.chunk_start_offset: index for index in indexes}
        self.counts = dict(summary.statistics.channel_message_counts) if summary.statistics is not None else {}

    def _scan(self) -> None:
        """Go through a file without a usable index, up to its first record that is not whole."""
        self._scanned = defaultdict(list)
        plain_bytes = messages = 0
        try:
            for at, record in _records(self._file, skip_magic=False):
                if isinstance(record, DataEnd):
                    return
                chunk, inside = -1, iter([(at, record)])
                if isinstance(record, Chunk):
                    _check_total(plain_bytes := plain_bytes + record.uncompressed_size, max_plain_bytes(self._size))
                    chunk, inside = at, chunk_records(record)
                for place, inner in inside:
                    if isinstance(inner, Message):
                        self._scanned[inner.channel_id].append((min(inner.log_time, MAX_TIME), chunk, place))
                        _check_total(messages := messages + 1, FREE_MESSAGES + self._size // ENTRY_BYTES)
                    self._describe(inner)
        except Exception:
            self.complete = False

    def _describe(self, record: McapRecord) -> None:
        """Keep a record that describes the file."""
        if isinstance(record, Channel):
            self.channels[record.id] = record
        elif isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
        elif isinstance(record, Attachment):
            self.attachments[record.name] = record.data

    # chunks

    def _entries(self, index: ChunkIndex, channel: int) -> NDArray[np.int64]:
        """(n, 3) log time, chunk and offset of a channel's messages in one chunk."""
        begin = index.chunk_start_offset
        if not index.message_index_offsets:  # the file has no message indexes: go through the chunk
            records = _records(BytesIO(self._plain(begin)))  # whose chunk is cached
            found = [(record.log_time, at) for at, record in records if isinstance(record, Message) and record.channel_id == channel]
        elif channel not in index.message_index_offsets:
            found = []
        else:
            at = index.message_index_offsets[channel]
            content = self._record(at, Opcode.MESSAGE_INDEX)
            end = begin + index.chunk_length
            if not end <= at <= at + RECORD_HEAD.size + len(content) <= end + index.message_index_length:
                raise ValueError("an index is not beside its chunk")
            entries = MessageIndex.read(ReadDataStream(BytesIO(content)))
            found = entries.records
            if entries.channel_id != channel or len({offset for _, offset in found}) != len(found):
                raise ValueError("an index is of another channel, or names a message twice")
        return np.array([(min(log_time, MAX_TIME), begin, min(at, MAX_TIME)) for log_time, at in found], np.int64).reshape(-1, 3)

    def _plain(self, at: int) -> bytes:
        """Return the unpacked bytes of the chunk at a file offset; the last few are cached."""
        with self._lock:
            if at in self._unpacked:
                self._unpacked.move_to_end(at)
                return self._unpacked[at]
        plain = unpack(Chunk.read(ReadDataStream(BytesIO(self._record(at, Opcode.CHUNK)))))
        if at in self._indexes and len(plain) != self._indexes[at].uncompressed_size:
            raise ValueError("a chunk and its index differ in size")
        with self._lock:
            self._unpacked[at] = plain
            while len(self._unpacked) > CACHED_CHUNKS:
                self._unpacked.popitem(last=False)
        return plain


def _records(stream: IO[bytes], skip_magic: bool = True) -> Iterator[tuple[int, McapRecord]]:
    """(offset, record) up to the end of a stream. Raises what the package raises where one is cut off."""
    size = stream.seek(0, SEEK_END)
    at = stream.seek(0) + (0 if skip_magic else len(MCAP0_MAGIC))
    try:
        for record in StreamReader(stream, skip_magic=skip_magic, emit_chunks=True, record_size_limit=size).records:
            yield at, record
            at = stream.tell()
    except EndOfFile:
        if stream.tell() < size or not skip_magic:
            raise


def chunk_records(chunk: Chunk) -> Iterator[tuple[int, McapRecord]]:
    """(offset in the unpacked chunk, record) of the records in a chunk. Raises as `unpack`, and what the package raises for damaged records."""
    return _records(BytesIO(unpack(chunk)))


def unpack(chunk: Chunk) -> bytes:
    """Unpack a chunk. Raises ValueError for one that claims more than `max_plain_bytes`, or whose length or CRC is not as claimed."""
    size = chunk.uncompressed_size
    if size > min(MAX_CHUNK_BYTES, max_plain_bytes(len(chunk.data))):
        raise ValueError(f"a chunk of {len(chunk.data)} bytes claims to hold {size}")
    if chunk.compression == "zstd":
        if zstandard.get_frame_parameters(chunk.data).content_size not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError("a chunk and what it packs differ in size")
        plain = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=max(size, 1))
    elif chunk.compression == "lz4":
        plain = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif not chunk.compression:
        plain = chunk.data
    else:
        raise ValueError(f"the compression '{chunk.compression[:20]}' is not known")
    if len(plain) != size or (chunk.uncompressed_crc and zlib.crc32(plain) != chunk.uncompressed_crc):
        raise ValueError("a chunk does not hold what was written")
    return bytes(plain)


def _content(plain: bytes, at: int, channel: int, log_time: int) -> bytes:
    """The content of the message of a channel and time whose record begins at an offset of a chunk."""
    if not 0 <= at <= len(plain) - RECORD_HEAD.size - MESSAGE_HEAD.size:
        raise ValueError("an offset leads out of its chunk")
    opcode, length = RECORD_HEAD.unpack_from(plain, at)
    begin, end = at + RECORD_HEAD.size + MESSAGE_HEAD.size, at + RECORD_HEAD.size + length
    found, _, logged, _ = MESSAGE_HEAD.unpack_from(plain, at + RECORD_HEAD.size)
    if opcode != Opcode.MESSAGE or not begin <= end <= len(plain) or (found, min(logged, MAX_TIME)) != (channel, log_time):
        raise ValueError("the index names a place where none of its messages is")
    return plain[begin:end]


def _check_total(total: int, most: int) -> None:
    if total > most:
        raise ValueError(f"its index asks for {total} bytes of {most}")


def damaged_file_error(path: Path | str) -> RecordingError:
    """Why a file cannot be read as MCAP, and the cure: it is none, is still being written, was cut off or damaged."""
    try:
        with open(path, "rb") as file:
            start = file.read(len(MCAP0_MAGIC))
            if start != MCAP0_MAGIC[: len(start)] or not start:
                return RecordingError(str(path), "is not an MCAP file", "give a file that trihedron run or another MCAP writer wrote")
            if is_being_written(file.fileno(), fcntl.LOCK_SH):
                return RecordingError(str(path), "is still being written", "wait until its run has ended")
            file.seek(-min(len(MCAP0_MAGIC), file.seek(0, 2)), 2)
            whole = file.read() == MCAP0_MAGIC
    except OSError as error:
        return RecordingError(str(path), f"cannot be read: {error.strerror}", "give the path of an MCAP file")
    cause = "is damaged" if whole else "is not a complete MCAP file: what wrote it was cut off"
    return RecordingError(str(path), cause, f"rescue what is whole with: trihedron recover {path}")


def in_use(path: Path | str) -> bool:
    """Return whether a process is writing the file; False where it cannot be opened."""
    try:
        with open(path, "rb") as file:
            return is_being_written(file.fileno(), fcntl.LOCK_SH)
    except OSError:
        return False


def is_being_written(descriptor: int, lock: int = fcntl.LOCK_EX) -> bool:
    """Return whether another process holds the file's lock, and take it if not. False where the file system has no locks."""
    try:
        fcntl.flock(descriptor, lock | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
