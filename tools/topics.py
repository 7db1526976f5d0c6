"""List the topics of a recording or any other MCAP file: schema, messages, first and last time, bytes.

Times are those of the messages (log_time): the stamps of the frames, in seconds.

Example: trihedron topics runs/latest/run.mcap
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from trihedron.pipeline.core.errors import printable
from trihedron.pipeline.core.text_table import table
from trihedron.tools.arguments import Parser

LEGACY_SCHEMA = "trihedron.Value"


@dataclass
class Topic:
    """One topic of a file. `bytes` counts the messages before compression; stamps in ns."""

    name: str
    schema: str
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    bytes: int = 0


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises RecordingError for a file that is missing, cut off or no MCAP."""
    parser = Parser("topics", __name__)
    parser.add_argument("file", metavar="FILE.mcap", type=Path, help="or the folder of a run")
    found = topics_of(parser.parse(argv).file)
    rows: list[list[str]] = [["topic", "schema", "messages", "first (s)", "last (s)", "bytes"]]
    for topic in found:
        first, last = (f"{stamp_ns / 1e9:.6f}" for stamp_ns in (topic.first_ns, topic.last_ns))
        rows.append([topic.name, topic.schema, str(topic.messages), first, last, str(topic.bytes)])
    print(table(rows, "llrrrr"))
    return 0


def topics_of(path: Path) -> list[Topic]:
    """The topics that have messages, by name, so far where the file is still being written; our own values show the type they hold. Raises
    RecordingError."""
    from trihedron.pipeline.record.mcap_file import McapFile, damaged_file_error, in_use

    file = McapFile(path)
    if not file.complete and not in_use(file.path):
        raise damaged_file_error(file.path)
    found: dict[int, Topic] = {}
    for channel, log_time, data in file.messages():
        topic = found.get(channel)
        if topic is None:
            name = file.schema_name(channel) or file.channels[channel].message_encoding
            name = _value_type(data) if name == LEGACY_SCHEMA else name
            topic = found[channel] = Topic(printable(file.channels[channel].topic, 120), printable(name, 120), first_ns=log_time, last_ns=log_time)
        topic.messages += 1
        topic.bytes += len(data)
        topic.first_ns, topic.last_ns = min(topic.first_ns, log_time), max(topic.last_ns, log_time)
    return sorted(found.values(), key=lambda topic: topic.name)


def _value_type(data: bytes) -> str:
    """The type of a value in a recording of format 4 or older, for example Pose."""
    from google.protobuf.message import DecodeError

    from trihedron.pipeline.record.codec import LegacyMessage

    try:
        return f"trihedron.{LegacyMessage.FromString(data).type}"
    except DecodeError:
        return LEGACY_SCHEMA
