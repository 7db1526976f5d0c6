"""Topics of a robot's recording: their roles, and the choice of those to read."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.readers import foxglove_messages, ros_messages
from trihedron.datasets.readers.picture_headers import UnreadableImage
from trihedron.datasets.readers.pixels import Kind, kind_of
from trihedron.datasets.readers.robot_values import Intrinsics, Picture, UnreadableMessage
from trihedron.pipeline.core.errors import DataError, did_you_mean

log = logging.getLogger("trihedron")


class Role(Enum):
    """Use of a topic to a reader of frames."""

    picture = "images"
    intrinsics = "camera intrinsics"
    links = "transforms"
    pose = "poses"


ROS: dict[str, tuple[Role, Callable[[bytes], Any]]] = {
    "sensor_msgs/msg/Image": (Role.picture, ros_messages.image),
    "sensor_msgs/msg/CompressedImage": (Role.picture, ros_messages.compressed_image),
    "sensor_msgs/msg/CameraInfo": (Role.intrinsics, ros_messages.camera_info),
    "tf2_msgs/msg/TFMessage": (Role.links, ros_messages.tf_message),
    "geometry_msgs/msg/TransformStamped": (Role.pose, ros_messages.transform_stamped),
    "geometry_msgs/msg/PoseStamped": (Role.pose, ros_messages.pose_stamped),
    "geometry_msgs/msg/PoseWithCovarianceStamped": (Role.pose, ros_messages.pose_with_covariance),
    "nav_msgs/msg/Odometry": (Role.pose, ros_messages.odometry),
}
FOXGLOVE = {
    "foxglove.RawImage": Role.picture,
    "foxglove.CompressedImage": Role.picture,
    "foxglove.CameraCalibration": Role.intrinsics,
    "foxglove.FrameTransform": Role.links,
    "foxglove.FrameTransforms": Role.links,
    "foxglove.PoseInFrame": Role.pose,
}
TRANSPORTS = ("/compressed", "/compressedDepth")  # what image_transport adds to the topic of the raw image


class MessageFile(Protocol):
    """A file of messages on topics: `McapFile` or `BagFile`."""

    path: Path

    @property
    def channels(self) -> Mapping[int, Any]:
        """By their numbers: `topic` and `message_encoding`."""

    def schema_name(self, channel: int) -> str:
        """Return the type of a channel's messages."""

    def locate(self, channel: int) -> Any:
        """Return an index of a channel's messages: its length and (n,) `log_times`."""

    def read(self, index: Any, row: int, most: int | None = None) -> bytes:
        """Read one message, or only its first `most` bytes."""


@dataclass(frozen=True)
class Stream:
    """A topic of use to frames; `decode` raises UnreadableMessage."""

    file: MessageFile
    channel: int
    topic: str
    role: Role
    decode: Callable[[bytes], Any]
    is_ros: bool

    @cached_property
    def index(self) -> Any:
        """The index of its messages."""
        return self.file.locate(self.channel)

    def at(self, row: int) -> Any:
        """The message of a row, decoded. Raises UnreadableMessage, and RecordingError where the file is damaged."""
        return self.decode(self.file.read(self.index, row))

    def values(self) -> Iterator[Any]:
        """All messages that can be decoded, in the order they were written."""
        for row in range(len(self.index)):
            try:
                yield self.at(row)
            except UnreadableMessage as error:
                log.warning("%s: message %d of %s %s; it is skipped", self.file.path, row, self.topic, error)

    def stamps_ns(self) -> NDArray[np.int64]:
        """(n,) stamps of the headers, -1 where there is none; log times where no header has been filled in."""
        stamps = np.full(len(self.index), -1, np.int64)
        for row in range(len(stamps)):
            try:
                if self.is_ros:
                    stamps[row] = ros_messages.stamp_ns(self.file.read(self.index, row, ros_messages.HEAD_BYTES))
                else:
                    stamps[row] = self.at(row).stamp_ns
            except UnreadableMessage as error:
                log.warning("%s: message %d of %s %s; it is skipped", self.file.path, row, self.topic, error)
        return self.index.log_times if len(stamps) and not (stamps > 0).any() else stamps


@dataclass(frozen=True)
class Streams:
    """The topics of a recording by their roles, in order of their names."""

    file: MessageFile

    @cached_property
    def all(self) -> tuple[Stream, ...]:
        """Every topic that has a role."""
        found = [_stream(self.file, channel) for channel in self.file.channels]
        return tuple(sorted((stream for stream in found if stream is not None), key=lambda stream: stream.topic))

    def of(self, role: Role) -> list[Stream]:
        """The topics of a role that hold messages."""
        return [stream for stream in self.all if stream.role is role and len(stream.index)]

    @cached_property
    def kinds(self) -> dict[str, Kind | None]:
        """Content of the first readable image of each topic of images."""
        return {stream.topic: _first_kind(stream) for stream in self.of(Role.picture)}

    def stream_named(self, topic: str, option: str, role: Role) -> Stream:
        """The topic that an option names. Raises DataError where it is not there or of another role."""
        there = {stream.topic: stream for stream in self.of(role)}
        if topic not in there:
            what = "holds other things" if topic in {c.topic for c in self.file.channels.values()} else "is not in the recording"
            raise DataError(f"dataset.{option}", f"the topic '{topic}' {what}", did_you_mean(topic, there))
        return there[topic]

    def images(self, kind: Kind, option: str, given: str) -> Stream:
        """The topic of colour or depth images: the one named, else the only one. Raises DataError where there is none, or several."""
        if given:
            return self.stream_named(given, option, Role.picture)
        found = self._of_kind(kind) or (self._of_kind(Kind.grey) if kind is Kind.color else [])
        if not found:
            unknown = [topic for topic, shown in self.kinds.items() if shown is None]
            cause = f"holds no {kind.value} images" + (f"; of unknown encoding: {', '.join(unknown)}" if unknown else "")
            topics = ", ".join(sorted({channel.topic for channel in self.file.channels.values()})[:12])
            raise DataError(str(self.file.path), cause, f"its topics are {topics or 'none'}")
        if len(found) > 1:
            cause = f"holds several topics of {kind.value} images: {', '.join(stream.topic for stream in found)}"
            raise DataError(str(self.file.path), cause, f"choose one with dataset.{option}=TOPIC")
        return found[0]

    def _of_kind(self, kind: Kind) -> list[Stream]:
        """Topics of a kind of images; of a raw image and its compressed copies only the raw one."""
        there = [stream for stream in self.of(Role.picture) if self.kinds[stream.topic] is kind]
        names = {stream.topic for stream in there}
        return [stream for stream in there if stream.topic == plain_topic(stream.topic) or plain_topic(stream.topic) not in names]

    def calibration(self, images: Stream, frame_id: str, option: str, given: str) -> Intrinsics | None:
        """The intrinsics that belong to a topic of images: of the topic named, else of the one beside it, else of the same coordinate frame.
        None where there is none. Raises DataError where several fit."""
        if given:
            return _first(self.stream_named(given, option, Role.intrinsics))
        streams = {stream.topic: stream for stream in self.of(Role.intrinsics)}
        folder = plain_topic(images.topic).rpartition("/")[0]
        beside = [topic for topic in streams if topic.rpartition("/")[0] == folder]
        same = [topic for topic in streams if _first(streams[topic]).frame_id.lstrip("/") == frame_id.lstrip("/")]
        for found in ([f"{folder}/camera_info"], [topic for topic in beside if topic in same], same, beside):
            there = [topic for topic in found if topic in streams]
            if len(there) == 1:
                return _first(streams[there[0]])
            if len(there) > 1:
                cause = f"holds several intrinsics for {images.topic}: {', '.join(there)}"
                raise DataError(str(self.file.path), cause, f"choose one with dataset.{option}=TOPIC")
        return None


def plain_topic(topic: str) -> str:
    """The topic of the raw image whose compressed copies this may be."""
    return next((topic.removesuffix(end) for end in sorted(TRANSPORTS, key=len, reverse=True) if topic.endswith(end)), topic)


def _stream(file: MessageFile, channel: int) -> Stream | None:
    kind, sent = file.schema_name(channel), file.channels[channel]
    make = partial(Stream, file, channel, sent.topic)
    if sent.message_encoding == "cdr" and kind in ROS:
        return make(*ROS[kind], True)
    if sent.message_encoding in ("protobuf", "json") and kind in FOXGLOVE:
        return make(FOXGLOVE[kind], foxglove_messages.reader(kind, sent.message_encoding), False)
    return None


def _first(stream: Stream) -> Intrinsics:
    """The first intrinsics with a focal length: some drivers send zeros until they are ready."""
    for found in stream.values():
        if isinstance(found, Intrinsics) and found.K[0, 0] > 0 and found.K[1, 1] > 0:
            return found
    raise DataError(str(stream.file.path), f"{stream.topic} holds no intrinsics with a focal length", "record the camera's calibration")


def _first_kind(stream: Stream) -> Kind | None:
    for picture in stream.values():
        assert isinstance(picture, Picture)
        try:
            return kind_of(picture)
        except UnreadableImage:
            continue
    return None
