"""Write a recording: an MCAP file with one channel per topic, and the metadata of the run that made it."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap_protobuf.schema import build_file_descriptor_set

from trihedron.pipeline.core.types import Frame, Value
from trihedron.pipeline.record.codec import FORMAT, FRAMES_TOPIC, METADATA, TIMING_TOPIC, Encoder
from trihedron.pipeline.record.embedded_images import messages_of
from trihedron.pipeline.record.foxglove import TopicView
from trihedron.pipeline.record.foxglove_server import FoxgloveServer
from trihedron.pipeline.record.mcap_writer import FLUSH_SECONDS, McapWriter
from trihedron.pipeline.record.schemas import PACKAGE, channel_metadata, definition, message_class

SPARSE_BYTES = 1 << 15  # assumed size of a value of a topic that is not dense


class RecordingWriter:
    """Writes values, well-known messages and timings. `log_time` is the frame's stamp, so the same run gives the same messages.

    Metadata comes first. When the file cannot be written any more, a warning reports it, and `close` raises RecordingError."""

    def __init__(self, path: Path | None, metadata: Mapping[str, str], server: FoxgloveServer | None = None, flush_s: float = FLUSH_SECONDS) -> None:
        """Write to a file, or none, at least every `flush_s` seconds; what viewers show goes to `server` too."""
        self.path = path
        self._file = McapWriter(path, server, flush_s)
        self._file.metadata(METADATA, {"format": FORMAT, **metadata})
        self._channels: dict[str, int] = {}
        self._encoders: dict[str, Encoder] = {}
        self._delayed: dict[str, deque[tuple[int, Value]]] = {}  # topic -> (frame before which it is due, value)
        self._frames = 0

    def attach(self, name: str, text: str) -> None:
        """Add a text file, for example the ground truth."""
        self._file.attach(name, text)

    def write(self, topic: str, value: Value, after: int = 0) -> None:
        """Add a value to its topic (name without slash); `after` so many frames, if it is only read then: next to what was made of it, which often
        repeats its bytes, it compresses better."""
        if topic == FRAMES_TOPIC:
            self._frames += 1
            self._release(self._frames)
        if after:
            self._delayed.setdefault(topic, deque()).append((self._frames + after, value))
        else:
            self._add(topic, value)

    def _release(self, frame: int | None) -> None:
        """Add the values delayed until this frame; None: all of them."""
        for topic, values in self._delayed.items():
            while values and (frame is None or values[0][0] <= frame):
                self._add(topic, values.popleft()[1])

    def _add(self, topic: str, value: Value) -> None:
        if self.path is not None:
            self._file.add(_memory_bytes(value), lambda: self._encode_messages(topic, value))

    def show(self, view: TopicView, value: Value, stamp_ns: int) -> None:
        """Add the viewer messages of a value; they are drawn by the writer's thread."""
        if view.wants(value):
            self._file.add(
                _memory_bytes(value), lambda: [self._message(channel, message, stamp_ns) for channel, message in view.draw_messages(value)]
            )

    def write_message(self, channel: str, message: Any, stamp_ns: int) -> None:
        """Add a protobuf message to a channel (with slash), made on first use."""
        self._file.add(message.ByteSize(), lambda: [self._message(channel, message, stamp_ns)])

    def write_timing(self, index: int, stamp_ns: int, frame_ms: float, stage_ms: Mapping[str, float], memory_mb: float) -> None:
        """Add a frame's times, and the memory the process holds after it."""
        self._file.add(0, lambda: [(self._own_channel(TIMING_TOPIC, "Timing"), stamp_ns, _timing(index, frame_ms, stage_ms, memory_mb))])

    def _encode_messages(self, topic: str, value: Value) -> list[tuple[int, int, bytes]]:
        if isinstance(value, Frame):
            return [self._message(f"/{topic}{part}", message, value.stamp_ns) for part, message in messages_of(value)]
        if topic not in self._encoders:
            self._encoders[topic] = Encoder()
        return [(self._own_channel(f"/{topic}", type(value).__name__), value.stamp_ns, self._encoders[topic].encode(value))]

    def _message(self, channel: str, message: Any, stamp_ns: int) -> tuple[int, int, bytes]:
        return self._channel(channel, type(message)), stamp_ns, message.SerializeToString()

    def _channel(self, channel: str, kind: Any) -> int:
        if channel not in self._channels:
            definition = build_file_descriptor_set(kind).SerializeToString()
            self._channels[channel] = self._file.channel(channel, kind.DESCRIPTOR.full_name, "protobuf", definition, "protobuf")
        return self._channels[channel]

    def _own_channel(self, channel: str, name: str) -> int:
        """The channel of messages `trihedron.<name>`."""
        if channel not in self._channels:
            described = f"{PACKAGE}.{name}", "protobuf", definition(name), "protobuf", channel_metadata(name)
            self._channels[channel] = self._file.channel(channel, *described)
        return self._channels[channel]

    def flush(self) -> None:
        """Write all values so far to the file, which lacks its index then."""
        self._release(None)
        self._file.flush()

    def close(self) -> None:
        """Write the index; the file is complete only then."""
        try:
            self._release(None)
        finally:
            self._file.close()


def _memory_bytes(value: Value) -> int:
    """Approximate memory that a value holds; its tables are shared with other versions."""
    return sum(item.nbytes for item in vars(value).values() if item.__class__ is np.ndarray) if value.dense else SPARSE_BYTES


def _timing(index: int, frame_ms: float, stage_ms: Mapping[str, float], memory_mb: float) -> bytes:
    """A message of `/timing`."""
    message = message_class("Timing")(index=index, frame_ms=frame_ms, stage_ms=stage_ms, memory_mb=memory_mb)
    return bytes(message.SerializeToString())
