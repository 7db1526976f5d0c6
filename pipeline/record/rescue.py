"""Rescue the whole messages of an MCAP file that was cut off, is damaged, or is still being written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from trihedron.pipeline.core.errors import DataError, RecordingError
from trihedron.pipeline.core.files import new_file, open_file
from trihedron.pipeline.record.mcap_file import chunk_records, damaged_file_error, is_being_written, max_plain_bytes

CHUNK_BYTES = 4 << 20


@dataclass
class Rescued:
    """The messages copied of a file, with log times in ns; chunks that are damaged inside; how far the file is whole, and its size in bytes."""

    messages: int = 0
    topics: set[str] = field(default_factory=set)
    first_ns: int = 0
    last_ns: int = 0
    damaged_chunks: int = 0
    whole_bytes: int = 0
    size: int = 0
    ended: bool = False  # with an end mark

    def __str__(self) -> str:
        times = f", {self.first_ns / 1e9:.3f} to {self.last_ns / 1e9:.3f} s" if self.messages else ""
        damage = f"; skipped {self.damaged_chunks} damaged chunks" if self.damaged_chunks else ""
        if self.ended:
            end = "the file has its end mark"
        else:
            end = f"the file ends without its end mark, after {self.whole_bytes} whole bytes of {self.size}"
        return f"copied {self.messages} messages on {len(self.topics)} topics{times}{damage}; {end}"


def recover(path: Path, out: Path, being_written: bool = False) -> Rescued:
    """Write the whole records of the file `path` to `out`, which may be the same; of a file that is being written those so far, if that is allowed.
    Raises RecordingError for a file that is missing, in use or no MCAP, DataError where nothing can be written."""
    try:
        source = open_file(path)
    except OSError as error:
        raise RecordingError(str(path), f"cannot be read: {error.strerror}", "give the path of an MCAP file") from error
    with source:
        if source.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC or (not being_written and is_being_written(source.fileno())):
            raise damaged_file_error(path)
        source.seek(0)
        try:
            with new_file(out) as new, open(new, "wb") as file:
                found = _copy(source, path.stat().st_size, file)
        except OSError as error:
            raise DataError(str(out), f"cannot be written: {error.strerror}", "give another --out") from error
    return found


def _copy(source: IO[bytes], size: int, file: IO[bytes]) -> Rescued:
    """Record after record, until one is not whole."""
    writer: Any = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(library="trihedron")
    copy = _Copy(writer, size)
    try:
        for record in StreamReader(source, emit_chunks=True, record_size_limit=size).records:
            copy.found.whole_bytes = min(source.tell(), size)
            copy.add(record)
        copy.found.ended = True
    except OSError:
        raise
    except Exception:  # whatever the package raises for damaged bytes: the file is whole up to here
        pass
    writer.finish()
    return copy.found


class _Copy:
    """Writes records again, channels and schemas under the numbers of the new file."""

    def __init__(self, writer: Any, size: int) -> None:
        self._writer = writer
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._schema_ids: dict[int, int] = {0: 0}
        self._channel_ids: dict[int, int] = {}
        self._plain_bytes = 0
        self.found = Rescued(size=size)

    def add(self, record: Any) -> None:
        """Take one record; indexes, statistics and the like are made anew."""
        if isinstance(record, Chunk):
            self._plain_bytes += record.uncompressed_size
            try:
                if self._plain_bytes > max_plain_bytes(self.found.size):
                    raise ValueError("its chunks claim to hold more than they can")
                for _, inner in chunk_records(record):
                    self.add(inner)
            except OSError:
                raise
            except Exception:
                self.found.damaged_chunks += 1
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif isinstance(record, Message) and record.channel_id in self._channels:
            self._message(record)

    def _message(self, message: Message) -> None:
        channel, found = self._channels[message.channel_id], self.found
        if channel.schema_id not in self._schema_ids:
            schema = self._schemas[channel.schema_id]
            self._schema_ids[channel.schema_id] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in self._channel_ids:
            schema_id = self._schema_ids[channel.schema_id]
            self._channel_ids[channel.id] = self._writer.register_channel(channel.topic, channel.message_encoding, schema_id, channel.metadata)
        self._writer.add_message(self._channel_ids[channel.id], message.log_time, message.data, message.publish_time, message.sequence)
        found.first_ns = min(found.first_ns, message.log_time) if found.messages else message.log_time
        found.last_ns = max(found.last_ns, message.log_time)
        found.messages += 1
        found.topics.add(channel.topic)
