"""List the topics of a recording or any other MCAP file: schema, messages, first and last time, bytes.

Times are those of the messages (log_time): the stamps of the frames, in seconds.

Example: trihedron topics runs/latest/run.mcap
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trihedron.pipeline.core.errors import RecordingError
from trihedron.tools.arguments import Parser, table

VALUE_SCHEMA = "trihedron.Value"


@dataclass
class Topic:
    """What a file holds of one topic. `bytes` counts the messages before compression; stamps in ns."""

    name: str
    schema: str
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    bytes: int = 0


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises RecordingError for a file that is missing, cut off or no MCAP."""
    parser = Parser("topics", __name__)
    parser.add_argument("file", metavar="FILE.mcap", type=Path)
    found = topics_of(parser.parse_args(argv).file)
    rows: list[list[str]] = [["topic", "schema", "messages", "first (s)", "last (s)", "bytes"]]
    for topic in found:
        first, last = (f"{stamp_ns / 1e9:.6f}" for stamp_ns in (topic.first_ns, topic.last_ns))
        rows.append([topic.name, topic.schema, str(topic.messages), first, last, str(topic.bytes)])
    print(table(rows, "llrrrr"))
    return 0


def topics_of(path: Path) -> list[Topic]:
    """The topics that have messages, by name; our own values show the type they hold. Raises RecordingError."""
    found: dict[int, Topic] = {}
    with _opened(path) as reader:
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            topic = found.get(channel.id)
            if topic is None:
                name = schema.name if schema is not None else channel.message_encoding
                name = _value_type(message.data) if name == VALUE_SCHEMA else name
                topic = found[channel.id] = Topic(channel.topic, name, first_ns=message.log_time, last_ns=message.log_time)
            topic.messages += 1
            topic.bytes += len(message.data)
            topic.first_ns, topic.last_ns = min(topic.first_ns, message.log_time), max(topic.last_ns, message.log_time)
    return sorted(found.values(), key=lambda topic: topic.name)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A reader of the file; what goes wrong with the file inside the block becomes a RecordingError."""
    from mcap.reader import SeekingReader

    from trihedron.pipeline.record.mcap_errors import DAMAGE, damaged

    try:
        with open(path, "rb") as file:
            yield SeekingReader(file, validate_crcs=True, record_size_limit=path.stat().st_size)
    except FileNotFoundError as error:
        raise RecordingError(str(path), f"cannot be read: {error.strerror}", "give the path of an MCAP file") from error
    except (OSError, *DAMAGE) as error:
        raise damaged(path) from error


def _value_type(data: bytes) -> str:
    """The type of value in a message of ours, for example Pose."""
    from trihedron.pipeline.record.codec import ValueMessage

    return f"trihedron.{ValueMessage.FromString(data).type}"
