"""Upgrade a recording or map of an older format: every topic that this program can read, after renaming, is written again."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import RecordingError, printable
from trihedron.pipeline.record.codec import (
    FORMAT,
    FRAMES_TOPIC,
    METADATA,
    TIMING_TOPIC,
    Decoder,
    Encoder,
    LegacyMessage,
    is_value_schema,
    timing_of,
)
from trihedron.pipeline.record.mcap_file import McapFile, damaged
from trihedron.pipeline.record.mcap_writer import McapWriter
from trihedron.pipeline.record.schemas import PACKAGE, definition, message_class

RENAMED_TYPES: dict[str, str] = {}  # name in an older recording -> name today, where only the name changed
RENAMED_FIELDS: dict[str, dict[str, str]] = {}  # type today -> older name of a field or table -> name today
ADDED_FIELDS: dict[tuple[str, int], dict[str, Any]] = {  # type and older version -> fields that it lacks
    ("Pose", 2): {"map_covariance": np.zeros((6, 6)), "noise_scale": 1.0},
    ("Map", 5): {"loop_closed": 0},
}
ADDED_COLUMNS = {("Map", 4): ("keyframes", "world_covariance", "covariance")}  # likewise -> table, the column that it lacks, and that which it copies


@dataclass
class Upgraded:
    """Messages copied, and the topics that were skipped with the reason: their values lack what this program needs."""

    messages: int = 0
    skipped: dict[str, str] = field(default_factory=dict)


def is_outdated(path: Path) -> bool:
    """Return whether a file is a recording or map of this program, complete, of an older format or with values that it cannot read as they are."""
    file = McapFile(path)
    if METADATA not in file.metadata or not file.complete or not file.indexed:
        return False
    return file.metadata[METADATA].get("format") != FORMAT or bool(_unreadable(file, rename=False))


def upgrade(source: Path, destination: Path) -> Upgraded:
    """Write an upgraded copy; an existing file is replaced only when all is done. Raises RecordingError where the source is damaged, its frames
    cannot be read, or the destination cannot be written."""
    file = McapFile(source)
    if not file.complete or not file.indexed:
        raise damaged(source)
    unreadable = _unreadable(file, rename=True)
    result = Upgraded(skipped={file.channels[channel].topic: why for channel, why in unreadable.items()})
    if f"/{FRAMES_TOPIC}" in result.skipped:
        raise RecordingError(str(source), f"cannot be upgraded: {result.skipped[f'/{FRAMES_TOPIC}']}", "record it again")
    partial = destination.with_name(destination.name + ".part")
    try:
        writer = McapWriter(partial)
        try:
            _copy(file, writer, unreadable, result)
        finally:
            writer.close()
        partial.replace(destination)
    finally:
        partial.unlink(missing_ok=True)
    return result


def _copy(file: McapFile, writer: McapWriter, unreadable: dict[int, str], result: Upgraded) -> None:
    writer.metadata(METADATA, {**file.metadata[METADATA], "format": FORMAT})
    for name, data in file.attachments.items():
        writer.attach(name, data.decode("utf-8", "replace"))
    numbers: dict[int, int] = {}
    codecs: dict[int, tuple[Decoder, Encoder]] = {}
    for channel, log_time, data in file.messages():
        if channel in unreadable:
            continue
        declared, schema = file.channels[channel], file.schemas.get(file.channels[channel].schema_id)
        described = (schema.name, schema.encoding, schema.data, declared.message_encoding) if schema is not None else ("", "", b"", "")
        if _is_value(file, channel):
            decoder, encoder = codecs.setdefault(channel, (_decoder(file, channel), Encoder()))
            value = decoder.decode(_renamed(data))
            data, described = encoder.encode(value), _described(type(value).__name__)
        elif declared.topic == TIMING_TOPIC:
            data, described = bytes(message_class("Timing")(**timing_of(data)).SerializeToString()), _described("Timing")
        if channel not in numbers:
            numbers[channel] = writer.channel(declared.topic, *described)
        message = (numbers[channel], log_time, data)
        writer.add(len(data), partial(list, [message]))
        result.messages += 1


def _described(name: str) -> tuple[str, str, bytes, str]:
    """Name, encoding and content of a schema of today, and the encoding of its messages."""
    return f"{PACKAGE}.{name}", "protobuf", definition(name), "protobuf"


def _unreadable(file: McapFile, rename: bool) -> dict[int, str]:
    """The channels of values whose first message cannot be decoded, and why."""
    causes: dict[int, str] = {}
    for channel in file.channels:
        chunks = file.chunks(channel) if _is_value(file, channel) else []
        for _, data in file.in_chunk(chunks[0], channel)[:1] if chunks else ():
            try:
                _decoder(file, channel).decode(_renamed(data) if rename else data)
            except RecordingError as error:
                causes[channel] = error.cause
    return causes


def _is_value(file: McapFile, channel: int) -> bool:
    return is_value_schema(file.schema_name(channel))


def _decoder(file: McapFile, channel: int) -> Decoder:
    return Decoder(f"{file.path}: topic {printable(file.channels[channel].topic, 80)}")


def _renamed(data: bytes) -> bytes:
    """A message with the names, fields and columns of today."""
    message = LegacyMessage.FromString(data)
    if not message.arrays:
        return data
    message.type = RENAMED_TYPES.get(message.type, message.type)
    fields, older = RENAMED_FIELDS.get(message.type, {}), (message.type, message.version)
    if not fields and older not in ADDED_FIELDS and older not in ADDED_COLUMNS:
        return data
    for array in message.arrays:
        name, mark, rest = array.name.partition("#")
        array.name = fields.get(name, name) + mark + rest
    if older in ADDED_COLUMNS:
        with suppress(Exception):  # a stranger's header, of which the decoder will say what is wrong
            _copy_column(message, *ADDED_COLUMNS[older])
    if older not in ADDED_FIELDS and older not in ADDED_COLUMNS:
        return bytes(message.SerializeToString())
    message.version += 1
    for name, value in ADDED_FIELDS.get(older, {}).items():
        array = np.asarray(value)
        kind = array.dtype.str.lstrip("<") if array.ndim else type(value).__name__
        message.arrays.add(name=name, dtype=kind, shape=array.shape, encoding="raw", data=array.tobytes())
    return _renamed(bytes(message.SerializeToString()))  # which may be an older version still


def _copy_column(message: Any, table: str, column: str, source: str) -> None:
    """Add a column to a table, or to a change of it, as a copy of another one."""
    arrays = {array.name: array for array in message.arrays}
    header = json.loads(arrays[f"{table}#"].data)
    if source not in header["schema"]:
        return
    header["schema"][column] = header["schema"][source]
    if source in header["rows"]:
        header["rows"][column] = header["rows"][source]
        copied = message.arrays.add()
        copied.CopyFrom(arrays[f"{table}#{source}"])
        copied.name = f"{table}#{column}"
    arrays[f"{table}#"].data = json.dumps(header).encode()
