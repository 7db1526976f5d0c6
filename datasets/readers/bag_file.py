"""Bags of ROS, read by rosbags: folders of rosbag2 (SQLite or MCAP, split or compressed) and files of ROS 1."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import RecordingError, TrihedronError, printable
from trihedron.pipeline.core.files import MAX_YAML_BYTES, SHOWN, open_file, parse_yaml, read_text
from trihedron.pipeline.core.layouts import METADATA_FILE
from trihedron.pipeline.core.libraries import imports_of

HEAD_BYTES = 12  # of each message, kept for its stamp
OLD_TYPES = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}  # ROS 1 -> the same message of ROS 2
CURE = "record it again, or convert it with ros2 bag convert"


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag; its messages are handed out as CDR."""

    topic: str
    kind: str
    message_encoding: str = "cdr"


@dataclass(frozen=True)
class BagIndex:
    """Messages of a topic: (n,) log times in ns, increasing, and the first bytes of each."""

    channel: int
    log_times: NDArray[np.int64]
    heads: tuple[bytes, ...]

    def __len__(self) -> int:
        return len(self.log_times)


class BagFile:
    """A bag opened for reading, with the interface of `McapFile`. Messages of `kinds` are listed in one pass over the bag, and read by their time.

    Raises RecordingError, one line, for whatever is wrong with a bag, LibraryError without rosbags."""

    complete = True

    def __init__(self, path: Path | str, kinds: Collection[str]) -> None:
        self.path = Path(path)
        self._kinds = kinds
        self._lock = threading.Lock()  # rosbags' readers have one position
        self._reader: Any
        with imports_of("rosbags"):
            from rosbags import rosbag1, rosbag2  # a tenth of a second, which other data sets need not wait

        self._is_ros1 = not self.path.is_dir()
        with self._one_line_errors():
            if not self._is_ros1:
                _check_folder(self.path)
                self._reader = rosbag2.Reader(self.path)
            else:
                open_file(self.path).close()  # a FIFO would block
                self._reader = rosbag1.Reader(self.path)
            self._reader.open()
            self._connections: dict[BagTopic, list[Any]] = defaultdict(list)  # ROS 1 has one a sender
            for connection in self._reader.connections:
                self._connections[BagTopic(connection.topic, OLD_TYPES.get(connection.msgtype, connection.msgtype))].append(connection)
        self.channels = dict(enumerate(sorted(self._connections, key=lambda topic: (topic.topic, topic.kind))))

    def schema_name(self, channel: int) -> str:
        """Return the type of a channel's messages."""
        return self.channels[channel].kind

    def locate(self, channel: int) -> BagIndex:
        """List the messages of a channel in order of log time. Raises RecordingError where the bag is damaged."""
        return self._indexes[channel]

    def read(self, index: BagIndex, row: int, most: int | None = None) -> bytes:
        """Read one message as CDR; only its first `most` bytes where those are known. Raises RecordingError where the bag is damaged."""
        if most is not None and most <= HEAD_BYTES:
            return index.heads[row][:most]
        topic, time = self.channels[index.channel], int(index.log_times[row])
        earlier = row - int(np.searchsorted(index.log_times, time))  # of the same time
        with self._one_line_errors(), self._lock:
            messages = self._reader.messages(self._connections[topic], start=time, stop=time + 1)
            data = next(islice((data for _, _, data in messages), earlier, None), None)
            if data is None:
                raise ValueError("a message is missing")
            return self._cdr(topic, data)

    @cached_property
    def _indexes(self) -> dict[int, BagIndex]:
        wanted = {topic: channel for channel, topic in self.channels.items() if topic.kind in self._kinds}
        topic_of = {(c.topic, c.msgtype): topic for topic in wanted for c in self._connections[topic]}
        found: dict[BagTopic, list[tuple[int, bytes]]] = defaultdict(list)
        connections = [connection for topic in wanted for connection in self._connections[topic]]
        with self._one_line_errors(), self._lock:
            for connection, time, data in self._reader.messages(connections) if connections else ():
                topic = topic_of[connection.topic, connection.msgtype]
                found[topic].append((time, self._cdr(topic, data)[:HEAD_BYTES]))
            indexes = {}
            for channel, topic in self.channels.items():
                rows = sorted(found[topic], key=lambda row: row[0])
                indexes[channel] = BagIndex(channel, np.array([time for time, _ in rows], np.int64), tuple(head for _, head in rows))
        return indexes

    def _cdr(self, topic: BagTopic, data: bytes) -> bytes:
        """The message as ROS 2 would have written it; empty where a message of ROS 1 is not of its type."""
        if not self._is_ros1:
            return bytes(data)
        types = _types()
        try:
            return bytes(types.ros1_to_cdr(data, topic.kind))
        except Exception:  # the generated code raises anything
            return b""

    @contextmanager
    def _one_line_errors(self) -> Iterator[None]:
        try:
            yield
        except TrihedronError:
            raise
        except Exception as error:
            cause = printable(f"{type(error).__name__}: {error}", 4 * SHOWN)
            raise RecordingError(str(self.path), f"cannot be read as a bag of ROS ({cause})", CURE) from error


@cache
def _types() -> Any:
    with imports_of("rosbags"):
        from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _check_folder(folder: Path) -> None:
    """Raise for a metadata.yaml that is no plain YAML of limited size, and for files that are none."""
    content = parse_yaml(read_text(folder / METADATA_FILE, MAX_YAML_BYTES))
    names = content["rosbag2_bagfile_information"]["relative_file_paths"]
    for name in names:
        file = folder / Path(name).name  # where rosbags looks
        if not file.is_file():
            raise ValueError(f"{printable(file.name, SHOWN)} is missing, or no regular file")
