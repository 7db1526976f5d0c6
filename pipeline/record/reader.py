"""Read a recording: topics in frame order, or one frame alone. Values are checked here, so that nothing behind needs to."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from mcap.records import Channel, ChunkIndex

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.types import Camera, FrameReference, Value
from trihedron.pipeline.core.value_checks import validate_value
from trihedron.pipeline.record.codec import FRAMES_TOPIC, METADATA, READABLE, UPGRADE, Decoder, builds_on, is_value_schema
from trihedron.pipeline.record.embedded_images import COLOR, DAMAGED, DEPTH, PARTS, frame_of, topic_of
from trihedron.pipeline.record.mcap_file import McapFile, damaged_file_error


class Recording:
    """A recording opened for reading, by its file or the folder of its run. Raises RecordingError when it is missing, damaged or not ours."""

    def __init__(self, path: Path | str) -> None:
        self._file = McapFile(path)
        self.path = self._file.path
        if not self._file.complete or not self._file.indexed:
            raise damaged_file_error(self.path)
        if METADATA not in self._file.metadata:
            raise RecordingError(str(path), "is an MCAP file, but not a recording of trihedron", "convert it with: trihedron convert SRC DST.mcap")
        self.metadata = self._file.metadata[METADATA]
        self.attachments = {name: data.decode("utf-8", "replace") for name, data in self._file.attachments.items()}
        self.channels: dict[str, Channel] = {c.topic: c for c in self._file.channels.values()}
        self.counts = {c.topic: self._file.counts.get(c.id, 0) for c in self.channels.values()}
        self.topics = {t[1:] for t, c in self.channels.items() if is_value_schema(self._file.schema_name(c.id))}
        self.embedded = {topic_of(channel) for channel in self.channels if channel.endswith(COLOR) and self._has_images(topic_of(channel))}
        self.topics |= self.embedded
        self._chunks: dict[str, list[ChunkIndex]] = {}
        if self.metadata.get("format") not in READABLE:
            written = " ".join(["trihedron", self.metadata.get("version", ""), self.metadata.get("commit", "")[:7]]).strip()
            form = self.metadata.get("format")
            cause = f"has format {form} of {written}, this program reads formats {READABLE[0]} to {READABLE[-1]}: {self._difference()}"
            raise RecordingError(str(path), cause, UPGRADE)

    def _has_images(self, topic: str) -> bool:
        """Return True if the channels of a topic's images are there, with the types of images."""
        channels = {f"/{topic}{part}": kind.DESCRIPTOR.full_name for part, kind in PARTS.items()}
        return all(name in self.channels and self._file.schema_name(self.channels[name].id) == kind for name, kind in channels.items())

    def _difference(self) -> str:
        """Why this program cannot read a recording of another format: the types of its first messages, those with other fields first."""
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
            raise RecordingError(str(self.path), "does not hold the command that made it", "the file is damaged; record it again")
        return found

    @cached_property
    def references(self) -> tuple[FrameReference, ...]:
        """The references to the frames, in order; equal cameras are one object. Raises RecordingError for a damaged one."""
        cameras: dict[Camera, Camera] = {}
        values = (value for value in self.values(FRAMES_TOPIC) if isinstance(value, FrameReference))
        return tuple(replace(value, camera=cameras.setdefault(value.camera, value.camera)) for value in values)

    def messages(self, channel: str) -> Iterator[tuple[int, bytes]]:
        """(log_time, data) of the messages of one channel (with slash), in the order they were written."""
        for chunk in self._holding(channel):
            yield from self._file.in_chunk(chunk, self.channels[channel].id)

    def values(self, topic: str, check: bool = True) -> Iterator[Value]:
        """The values of a topic in frame order, each checked by itself unless they are only compared. Raises RecordingError for a value that breaks
        the declarations of its type."""
        if topic in self.embedded:
            for frame in self._frames(topic):
                yield validate_value(topic, frame, str(self.path), _expected_type(topic)) if check else frame
            return
        decoder, place = self._decoder(topic), str(self.path)
        for _, data in self.messages(f"/{topic}"):
            value = decoder.decode(data)
            yield validate_value(topic, value, place, _expected_type(topic)) if check else value

    def _frames(self, topic: str) -> Iterator[Value]:
        """The frames of embedded images, whose numbers and cameras are in the topic `frames`."""
        references, place = self.values(FRAMES_TOPIC), f"{self.path}: topic /{topic}"
        for (stamp_ns, color), (depth_ns, depth) in zip(self.messages(f"/{topic}{COLOR}"), self.messages(f"/{topic}{DEPTH}")):
            reference = next((value for value in references if value.stamp_ns == stamp_ns), None)
            if not isinstance(reference, FrameReference) or depth_ns != stamp_ns:
                raise RecordingError(place, f"has images of the time {stamp_ns / 1e9:.9f} s, at which it has no frame", DAMAGED)
            yield frame_of(reference, color, depth, place)

    def frame(self, index: int, check: bool = True) -> dict[str, Value]:
        """Read the values of every topic at one frame, checked as in `values`; empty when there is none of this number. Reads only the chunks it
        needs."""
        reference = self.reference(index)
        if reference is None:
            return {}
        found = {topic: self.value(topic, reference.stamp_ns, check) for topic in sorted(self.topics)}
        return {topic: value for topic, value in found.items() if value is not None and value.index == index}

    def reference(self, index: int) -> FrameReference | None:
        """The reference of a frame, found by bisection, since frame numbers grow; None where there is none of this number."""
        channel, decoder = f"/{FRAMES_TOPIC}", self._decoder(FRAMES_TOPIC)
        chunks = self._holding(channel)
        low, high = 0, len(chunks)
        while low < high:
            middle = (low + high) // 2
            found = [decoder.decode(data) for _, data in self._file.in_chunk(chunks[middle], self.channels[channel].id)]
            for value in found:
                if value.index == index and isinstance(value, FrameReference):
                    return value
            low, high = (middle + 1, high) if not found or found[-1].index < index else (low, middle)
        return None

    def value(self, topic: str, stamp_ns: int, check: bool = True) -> Value | None:
        """The value of a topic with this stamp, checked as in `values`, or None."""
        if topic in self.embedded:
            reference, color, depth = (
                self.value(FRAMES_TOPIC, stamp_ns, check),
                *(self._message(f"/{topic}{part}", stamp_ns) for part in (COLOR, DEPTH)),
            )
            if not isinstance(reference, FrameReference) or color is None or depth is None:
                return None
            frame = frame_of(reference, color, depth, f"{self.path}: topic /{topic}")
            return validate_value(topic, frame, str(self.path), _expected_type(topic)) if check else frame
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
                        value = self._decoder(topic).decode_last(chain[::-1])
                        return validate_value(topic, value, str(self.path), _expected_type(topic)) if check else value
                    skipped = back - 1
        return None

    def _message(self, channel: str, stamp_ns: int) -> bytes | None:
        """The message of a channel with this stamp, or None."""
        for chunk in self._holding(channel):
            if chunk.message_start_time <= stamp_ns <= chunk.message_end_time:
                for log_time, data in self._file.in_chunk(chunk, self.channels[channel].id):
                    if log_time == stamp_ns:
                        return data
        return None

    def _holding(self, channel: str) -> list[ChunkIndex]:
        """The chunks with messages of a channel (with slash), in file order."""
        if channel not in self._chunks:
            self._chunks[channel] = self._file.chunks(self.channels[channel].id) if channel in self.channels else []
        return self._chunks[channel]

    def _decoder(self, topic: str) -> Decoder:
        return Decoder(f"{self.path}: topic /{topic}")


def _expected_type(topic: str) -> type[Value]:
    """The type of the values of a topic that is of no slot."""
    return FrameReference if topic == FRAMES_TOPIC else Value


class TopicReader:
    """A topic of a recording, read frame by frame in increasing order."""

    def __init__(self, recording: Recording, topic: str, check: bool = True) -> None:
        self._values = recording.values(topic, check)
        self._next: deque[Value] = deque()
        self.latest: Value | None = None  # the last value before the requested frame

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
