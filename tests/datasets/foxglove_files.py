"""Recordings with Foxglove's schemas, written with libraries that share no code with the reader."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mcap.writer import Writer
from mcap_protobuf.writer import Writer as ProtobufWriter

Message = tuple[str, int, Any]  # topic, log time in ns, protobuf message


def write_protobuf(path: Path, messages: Iterable[Message], **options: Any) -> Path:
    """As protobuf; the options of the writer say how it is packed."""
    with open(path, "wb") as file, ProtobufWriter(file, **options) as writer:
        for topic, log_time, value in messages:
            writer.write_message(topic, value, log_time, log_time)
    return path


def write_json(path: Path, messages: Iterable[Message], **options: Any) -> Path:
    """The same as JSON."""
    with open(path, "wb") as file:
        writer = Writer(file, **options)
        writer.start()
        channels: dict[str, int] = {}
        for topic, log_time, value in messages:
            if topic not in channels:
                schema = writer.register_schema(value.DESCRIPTOR.full_name, "jsonschema", b"{}")
                channels[topic] = writer.register_channel(topic, "json", schema)
            writer.add_message(channels[topic], log_time, json.dumps(as_json(value)).encode(), log_time)
        writer.finish()
    return path


def as_json(value: Any) -> Any:
    """Foxglove's JSON: times as sec and nsec, bytes as base64."""
    if hasattr(value, "DESCRIPTOR"):
        if value.DESCRIPTOR.full_name == "google.protobuf.Timestamp":
            return {"sec": value.seconds, "nsec": value.nanos}
        return {field.name: as_json(getattr(value, field.name)) for field in value.DESCRIPTOR.fields}
    if isinstance(value, bytes):
        return b64encode(value).decode()
    return value if isinstance(value, (str, int, float)) else [as_json(one) for one in value]
