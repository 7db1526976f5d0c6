"""A recording: an MCAP file with one channel per topic, and what made it as metadata."""

from __future__ import annotations

import json
import struct
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from operator import methodcaller
from pathlib import Path
from typing import Any

import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from trihedron.pipeline.codec import Decoder, Encoder, ValueMessage
from trihedron.pipeline.errors import RecordingError
from trihedron.pipeline.types import Value

FORMAT = "2"
METADATA = "trihedron"
CHUNK_BYTES = 1 << 20
CHUNK_SECONDS = 0.5
MESSAGE_OVERHEAD = 64  # bytes of a message beside its data, generously
TIMING_TOPIC = "/timing"
DAMAGE = (McapError, ValueError, EOFError, AssertionError, KeyError, struct.error, zstandard.ZstdError, RuntimeError)  # by damaged bytes
_close_chunk = methodcaller("_Writer__finalize_chunk")  # the library closes a chunk by size only, and a crash would lose a slow topic's last minutes
TIMING_SCHEMA = {
    "type": "object",
    "properties": {
        "index": {"type": "integer"},
        "frame_ms": {"type": "number"},
        "stage_ms": {"type": "object"},
        "memory_mb": {"type": "number", "description": "resident, of the whole process"},
    },
}


class RecordingWriter:
    """Writes values, well-known messages and timings. `log_time` is the frame's stamp, so the same run gives the same messages.

    Metadata goes first; a chunk is closed before it would exceed `CHUNK_BYTES` (a larger message has one of its own)
    and after `CHUNK_SECONDS` of wall time, so that a crash loses little."""

    def __init__(self, path: Path, metadata: Mapping[str, str]) -> None:
        self.path = path
        try:
            self._file = open(path, "wb")
        except OSError as error:
            raise RecordingError(str(path), f"cannot be written: {error.strerror}", "give another out=FOLDER") from error
        self._writer: Any = Writer(self._file, chunk_size=2 * CHUNK_BYTES, compression=CompressionType.LZ4)  # fast: most of it hardly shrinks
        self._writer.start(library="trihedron")
        self._writer.add_metadata(METADATA, {"format": FORMAT, **metadata})
        self._file.flush()
        self._channels: dict[str, int] = {}
        self._encoders: dict[str, Encoder] = {}
        self._chunk_began, self._chunk_bytes = time.monotonic(), 0

    def attach(self, name: str, text: str) -> None:
        """Add a text file, for example the ground truth."""
        self._writer.add_attachment(create_time=0, log_time=0, name=name, media_type="text/plain", data=text.encode())

    def write(self, topic: str, value: Value) -> None:
        """Add a value to its topic (name without slash)."""
        message = self._encoders.setdefault(topic, Encoder()).encode(value)
        self.write_message(f"/{topic}", message, value.stamp_ns)

    def write_message(self, channel: str, message: Any, stamp_ns: int) -> None:
        """Add a protobuf message to a channel (with slash), made on first use."""
        if channel not in self._channels:
            schema = build_file_descriptor_set(type(message)).SerializeToString()
            schema_id = self._writer.register_schema(message.DESCRIPTOR.full_name, "protobuf", schema)
            self._channels[channel] = self._writer.register_channel(channel, "protobuf", schema_id)
        self._add(channel, message.SerializeToString(), stamp_ns)

    def write_timing(self, index: int, stamp_ns: int, frame_ms: float, stage_ms: Mapping[str, float], memory_mb: float) -> None:
        """Add a frame's times, and the memory the process holds after it (JSON, so that any viewer plots them)."""
        if TIMING_TOPIC not in self._channels:
            schema_id = self._writer.register_schema("trihedron.Timing", "jsonschema", json.dumps(TIMING_SCHEMA).encode())
            self._channels[TIMING_TOPIC] = self._writer.register_channel(TIMING_TOPIC, "json", schema_id)
        stages = {name: round(ms, 3) for name, ms in stage_ms.items()}
        measured = {"index": index, "frame_ms": round(frame_ms, 3), "stage_ms": stages, "memory_mb": round(memory_mb, 2)}
        self._add(TIMING_TOPIC, json.dumps(measured).encode(), stamp_ns)

    def _add(self, channel: str, data: bytes, stamp_ns: int) -> None:
        try:
            if self._chunk_bytes + len(data) + MESSAGE_OVERHEAD > CHUNK_BYTES:
                self._finish_chunk()
            self._writer.add_message(self._channels[channel], log_time=stamp_ns, data=data, publish_time=stamp_ns)
            self._chunk_bytes += len(data) + MESSAGE_OVERHEAD
            if time.monotonic() - self._chunk_began > CHUNK_SECONDS:
                self._finish_chunk()
        except OSError as error:
            raise RecordingError(str(self.path), f"cannot be written: {error.strerror}", "what was written before is kept") from error

    def _finish_chunk(self) -> None:
        _close_chunk(self._writer)
        self._file.flush()
        self._chunk_began, self._chunk_bytes = time.monotonic(), 0

    def close(self) -> None:
        """Write the index; the file is complete only then."""
        if not self._file.closed:
            self._writer.finish()
            self._file.close()


class Recording:
    """A recording opened for reading. Raises RecordingError when it is missing, damaged or not ours."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            with open(self.path, "rb") as file:
                reader = make_reader(file)
                summary = reader.get_summary()
                found = {m.name: m.metadata for m in reader.iter_metadata()}
                self.attachments = {a.name: a.data.decode("utf-8", "replace") for a in reader.iter_attachments()}
        except OSError as error:
            raise RecordingError(str(path), f"cannot be read: {error.strerror}", "give the path of a run.mcap") from error
        except DAMAGE as error:
            raise RecordingError(str(path), "is not a complete MCAP file", "the run that wrote it was cut off; record it again") from error
        if METADATA not in found or summary is None:
            raise RecordingError(str(path), "is an MCAP file, but not a recording of trihedron", "convert it with: trihedron convert SRC DST.mcap")
        self.metadata: dict[str, str] = dict(found[METADATA])
        if self.metadata.get("format") != FORMAT:
            written = " ".join(["trihedron", self.metadata.get("version", ""), self.metadata.get("commit", "")[:7]]).strip()
            cause = f"has format {self.metadata.get('format')} of {written}, this program reads format {FORMAT}: other arrays and tables"
            raise RecordingError(str(path), cause, "read it with the version that wrote it, or record again")
        counts = summary.statistics.channel_message_counts if summary.statistics else {}
        self.channels: dict[str, Channel] = {c.topic: c for c in summary.channels.values()}
        self.counts = {c.topic: counts.get(c.id, 0) for c in summary.channels.values()}
        schemas = {i for i, schema in summary.schemas.items() if schema.name == ValueMessage.DESCRIPTOR.full_name}
        self.topics = {c.topic[1:] for c in self.channels.values() if c.schema_id in schemas}

    def overrides(self) -> list[str]:
        """The overrides of the command that made the recording."""
        return [str(text) for text in json.loads(self.metadata.get("overrides", "[]"))]

    def messages(self, channel: str) -> Iterator[Message]:
        """The messages of one channel in the order they were written."""
        try:
            with open(self.path, "rb") as file:
                for _, _, message in make_reader(file, validate_crcs=True).iter_messages(topics=[channel], log_time_order=False):
                    yield message
        except (OSError, *DAMAGE) as error:
            raise RecordingError(str(self.path), f"channel {channel} is damaged", "record it again") from error

    def values(self, topic: str) -> Iterator[Value]:
        """The values of a topic in frame order."""
        decoder = Decoder(f"{self.path}: topic /{topic}")
        for message in self.messages(f"/{topic}"):
            yield decoder.decode(message.data)


class FrameReader:
    """Values of one topic whose messages stand alone (frames), in any order and from any thread."""

    def __init__(self, recording: Recording, topic: str) -> None:
        self._place, self._channel = f"{recording.path}: topic /{topic}", f"/{topic}"
        self._lock = threading.Lock()
        self._reader = make_reader(open(recording.path, "rb"))

    def at(self, stamp_ns: int) -> Value | None:
        """The value with this stamp, or None."""
        with self._lock:
            found = [m.data for _, _, m in self._reader.iter_messages([self._channel], starting_at=stamp_ns, ending_at=stamp_ns)]
        return Decoder(self._place).decode(found[0]) if found else None


class TopicReader:
    """A topic of a recording, asked for frame by frame in increasing order."""

    def __init__(self, recording: Recording, topic: str) -> None:
        self._values = recording.values(topic)
        self._next: deque[Value] = deque()
        self.latest: Value | None = None  # the last value before the frame asked for

    def at(self, index: int) -> Value | None:
        """The value written at frame `index`, or None."""
        while True:
            if not self._next:
                value = next(self._values, None)
                if value is None:
                    return None
                self._next.append(value)
            if self._next[0].index > index:
                return None
            value = self._next.popleft()
            if value.index == index:
                return value
            self.latest = value
