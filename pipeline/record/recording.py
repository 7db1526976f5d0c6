"""A recording: an MCAP file with one channel per topic, and what made it as metadata."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, ChunkIndex
from mcap_protobuf.schema import build_file_descriptor_set

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.types import Value
from trihedron.pipeline.record.array_codec import row_kernels
from trihedron.pipeline.record.chunk_writer import ChunkWriter
from trihedron.pipeline.record.codec import Decoder, Encoder, ValueMessage, builds_on
from trihedron.pipeline.record.foxglove import View
from trihedron.pipeline.record.mcap_errors import damaged
from trihedron.pipeline.record.mcap_file import McapFile

FORMAT = "4"
READ = ("3", FORMAT)  # 3: a table was always changed from the message before
METADATA = "trihedron"
FRAMES_TOPIC = "frames"  # one FrameReference a frame: what a replay iterates over
FEW_BYTES = 1 << 15  # what a value of a topic that is not dense is taken to hold
TIMING_TOPIC = "/timing"
TIMING_SCHEMA = {
    "type": "object",
    "properties": {
        "index": {"type": "integer"},
        "frame_ms": {"type": "number"},
        "stage_ms": {"type": "object", "properties": {slot: {"type": "number"} for slot in SLOTS}},  # viewers read no object without properties
        "memory_mb": {"type": "number", "description": "resident, of the whole process"},
    },
}


class RecordingWriter:
    """Writes values, well-known messages and timings. `log_time` is the frame's stamp, so the same run gives the same messages.

    Metadata goes first. Where the file cannot be written any more, a warning says so, and `close` raises RecordingError."""

    def __init__(self, path: Path, metadata: Mapping[str, str]) -> None:
        self.path = path
        row_kernels().ready()
        self._file = ChunkWriter(path)
        self._file.metadata(METADATA, {"format": FORMAT, **metadata})
        self._channels: dict[str, int] = {}
        self._encoders: dict[str, Encoder] = {}
        self._held: dict[str, deque[tuple[int, Value]]] = {}  # topic -> the frame before which it is due, and what
        self._frames = 0

    def attach(self, name: str, text: str) -> None:
        """Add a text file, for example the ground truth."""
        self._file.attach(name, text)

    def write(self, topic: str, value: Value, after: int = 0) -> None:
        """Add a value to its topic (name without slash); so many frames later, if it is only asked for then: what was made of it, often the same
        bytes, stands beside it then."""
        if topic == FRAMES_TOPIC:
            self._frames += 1
            self._release(self._frames)
        if after:
            self._held.setdefault(topic, deque()).append((self._frames + after, value))
        else:
            self._add(topic, value)

    def _release(self, frame: int | None) -> None:
        """Add what was held back until this frame; None: whatever was."""
        for topic, values in self._held.items():
            while values and (frame is None or values[0][0] <= frame):
                self._add(topic, values.popleft()[1])

    def _add(self, topic: str, value: Value) -> None:
        self._file.add(_bytes_of(value), lambda: self._encoded(topic, value))

    def show(self, view: View, value: Value, stamp_ns: int) -> None:
        """Add what viewers show of a value. Values are drawn when their turn in the file has come."""
        if view.wants(value):
            self._file.add(_bytes_of(value), lambda: [self._message(channel, message, stamp_ns) for channel, message in view.drawn(value)])

    def write_message(self, channel: str, message: Any, stamp_ns: int) -> None:
        """Add a protobuf message to a channel (with slash), made on first use."""
        self._file.add(message.ByteSize(), lambda: [self._message(channel, message, stamp_ns)])

    def write_timing(self, index: int, stamp_ns: int, frame_ms: float, stage_ms: Mapping[str, float], memory_mb: float) -> None:
        """Add a frame's times, and the memory the process holds after it (JSON, so that any viewer plots them)."""
        self._file.add(0, lambda: [(self._timing_channel(), stamp_ns, _timing(index, frame_ms, stage_ms, memory_mb))])

    def _encoded(self, topic: str, value: Value) -> list[tuple[int, int, bytes]]:
        if topic not in self._encoders:
            self._encoders[topic] = Encoder()
        return [(self._channel(f"/{topic}", ValueMessage), value.stamp_ns, self._encoders[topic].encode(value))]

    def _message(self, channel: str, message: Any, stamp_ns: int) -> tuple[int, int, bytes]:
        return self._channel(channel, type(message)), stamp_ns, message.SerializeToString()

    def _channel(self, channel: str, kind: Any) -> int:
        if channel not in self._channels:
            definition = build_file_descriptor_set(kind).SerializeToString()
            self._channels[channel] = self._file.channel(channel, kind.DESCRIPTOR.full_name, "protobuf", definition, "protobuf")
        return self._channels[channel]

    def _timing_channel(self) -> int:
        if TIMING_TOPIC not in self._channels:
            definition = json.dumps(TIMING_SCHEMA).encode()
            self._channels[TIMING_TOPIC] = self._file.channel(TIMING_TOPIC, "trihedron.Timing", "jsonschema", definition, "json")
        return self._channels[TIMING_TOPIC]

    def close(self) -> None:
        """Write the index; the file is complete only then."""
        try:
            self._release(None)
        finally:
            self._file.close()


def _bytes_of(value: Value) -> int:
    """Of memory that a value holds, about; its tables are shared with others."""
    return sum(item.nbytes for item in vars(value).values() if item.__class__ is np.ndarray) if value.dense else FEW_BYTES


def _timing(index: int, frame_ms: float, stage_ms: Mapping[str, float], memory_mb: float) -> bytes:
    """A message of TIMING_SCHEMA."""
    stages = ", ".join([f"{_quoted(name)}: {ms:.3f}" for name, ms in stage_ms.items()])
    return f'{{"index": {index}, "frame_ms": {frame_ms:.3f}, "stage_ms": {{{stages}}}, "memory_mb": {memory_mb:.2f}}}'.encode()


_quoted = cache(json.dumps)  # names of stages


class Recording:
    """A recording opened for reading. Raises RecordingError when it is missing, damaged or not ours."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._file = McapFile(self.path)
        if not self._file.complete or not self._file.indexed:
            raise damaged(self.path)
        if METADATA not in self._file.metadata:
            raise RecordingError(str(path), "is an MCAP file, but not a recording of trihedron", "convert it with: trihedron convert SRC DST.mcap")
        self.metadata = self._file.metadata[METADATA]
        self.attachments = {name: data.decode("utf-8", "replace") for name, data in self._file.attachments.items()}
        self.channels: dict[str, Channel] = {c.topic: c for c in self._file.channels.values()}
        self.counts = {c.topic: self._file.counts.get(c.id, 0) for c in self.channels.values()}
        self.topics = {t[1:] for t, c in self.channels.items() if self._file.schema_name(c.id) == ValueMessage.DESCRIPTOR.full_name}
        self._chunks: dict[str, list[ChunkIndex]] = {}
        if self.metadata.get("format") not in READ:
            written = " ".join(["trihedron", self.metadata.get("version", ""), self.metadata.get("commit", "")[:7]]).strip()
            cause = f"has format {self.metadata.get('format')} of {written}, this program reads formats {' and '.join(READ)}: {self._difference()}"
            raise RecordingError(str(path), cause, "read it with the version that wrote it, or record again")

    def _difference(self) -> str:
        """Of a recording of another format: what its first messages hold that this program does not read, types with other fields first."""
        causes: list[str] = []
        for topic in sorted(self.topics):
            try:
                next(self.values(topic), None)
            except RecordingError as error:
                causes.append(f"topic /{topic} {error.cause}")
        causes.sort(key=lambda cause: "the field" not in cause)
        more = f", and {len(causes) - 1} more of its topics are others" if len(causes) > 1 else ""
        return causes[0] + more if causes else "its arrays and tables are packed otherwise"

    def overrides(self) -> list[str]:
        """The overrides of the command that made the recording. Raises RecordingError where they are no list of texts."""
        try:
            found = json.loads(self.metadata.get("overrides", "[]"))
        except (ValueError, RecursionError):
            found = None
        if not isinstance(found, list) or not all(isinstance(text, str) for text in found):
            raise RecordingError(str(self.path), "does not say which command made it", "the file is damaged; record it again")
        return found

    def messages(self, channel: str) -> Iterator[tuple[int, bytes]]:
        """(log_time, data) of the messages of one channel (with slash), in the order they were written."""
        for chunk in self._holding(channel):
            yield from self._file.in_chunk(chunk, self.channels[channel].id)

    def values(self, topic: str) -> Iterator[Value]:
        """The values of a topic in frame order."""
        decoder = self._decoder(topic)
        for _, data in self.messages(f"/{topic}"):
            yield decoder.decode(data)

    def frame(self, index: int) -> dict[str, Value]:
        """What every topic holds of one frame; empty when there is none of this number. Reads only the chunks it needs."""
        reference = self._reference(index)
        if reference is None:
            return {}
        found = {topic: self.value(topic, reference.stamp_ns) for topic in sorted(self.topics)}
        return {topic: value for topic, value in found.items() if value is not None and value.index == index}

    def value(self, topic: str, stamp_ns: int) -> Value | None:
        """The value of a topic with this stamp, or None."""
        chain: list[bytes] = []
        channel, skipped = f"/{topic}", 0
        for chunk in reversed(self._holding(channel)):
            if not chain and not chunk.message_start_time <= stamp_ns <= chunk.message_end_time:
                continue
            if skipped and skipped >= (count := self._file.count_in_chunk(chunk, self.channels[channel].id)):
                skipped -= count
                continue
            for log_time, data in reversed(self._file.in_chunk(chunk, self.channels[channel].id)):
                if skipped:
                    skipped -= 1
                elif chain or log_time == stamp_ns:
                    chain.append(data)
                    back = builds_on(data)
                    if back == 0:
                        return self._decoder(topic).decode_last(chain[::-1])
                    skipped = back - 1
        return None

    def _holding(self, channel: str) -> list[ChunkIndex]:
        """The chunks with messages of a channel (with slash), in file order."""
        if channel not in self._chunks:
            self._chunks[channel] = self._file.chunks(self.channels[channel].id) if channel in self.channels else []
        return self._chunks[channel]

    def _decoder(self, topic: str) -> Decoder:
        return Decoder(f"{self.path}: topic /{topic}")

    def _reference(self, index: int) -> Value | None:
        """The FrameReference of a frame, by bisection: frame numbers grow."""
        channel, decoder = f"/{FRAMES_TOPIC}", self._decoder(FRAMES_TOPIC)
        chunks = self._holding(channel)
        low, high = 0, len(chunks)
        while low < high:
            middle = (low + high) // 2
            found = [decoder.decode(data) for _, data in self._file.in_chunk(chunks[middle], self.channels[channel].id)]
            for value in found:
                if value.index == index:
                    return value
            low, high = (middle + 1, high) if not found or found[-1].index < index else (low, middle)
        return None


class FrameReader:
    """Values of one topic whose messages stand alone (frames), in any order and from any thread."""

    def __init__(self, recording: Recording, topic: str) -> None:
        self._recording, self._topic = recording, topic

    def at(self, stamp_ns: int) -> Value | None:
        """The value with this stamp, or None."""
        return self._recording.value(self._topic, stamp_ns)


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
