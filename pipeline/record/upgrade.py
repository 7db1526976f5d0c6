"""Upgrade a recording or map of an older format: every topic that this program can read, after renaming, is written again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap_protobuf.schema import build_file_descriptor_set

from trihedron.pipeline.core.constraints import Columns
from trihedron.pipeline.core.errors import RecordingError, printable
from trihedron.pipeline.core.types import CALIBRATION, PROPOSALS, USUAL_TURN_DIFFERENCE, Frame
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
from trihedron.pipeline.record.embedded_images import messages_of
from trihedron.pipeline.record.mcap_file import McapFile, damaged_file_error
from trihedron.pipeline.record.mcap_writer import McapWriter, new_recording
from trihedron.pipeline.record.schemas import PACKAGE, definition, message_class

RENAMED_TYPES: dict[str, str] = {}  # name in an older recording -> name today, where only the name changed
RENAMED_FIELDS: dict[str, dict[str, str]] = {}  # type today -> older name of a field or table -> name today
ADDED_FIELDS: dict[tuple[str, int], dict[str, Any]] = {  # type and older version -> fields that it lacks
    ("Pose", 2): {"map_covariance": np.zeros((6, 6)), "noise_scale": 1.0},
    ("Pose", 3): {
        "sensitivity": np.zeros((6, CALIBRATION)),
        "twist": np.zeros(6),
        "reference_twist": np.zeros(6),
        "calibration_information": np.zeros((CALIBRATION, CALIBRATION)),
        "calibration_score": np.zeros(CALIBRATION),
    },
    ("Pose", 4): {"keyframe_covariance": np.zeros((6, 6))},
    ("Pose", 5): {"turn_difference": np.zeros(3), "usual_turn_difference": USUAL_TURN_DIFFERENCE},
    ("Pose", 6): {},  # counts of planes, in whose place `plane_offsets` is since version 11
    ("Pose", 7): {"confirmations": 0},
    ("Pose", 8): {"jumps": 0, "usual_accelerations": np.zeros(3)},
    ("Pose", 9): {"scale_difference": 0.0},
    ("Pose", 10): {"plane_offsets": np.zeros(3)},
    ("Tracks", 1): {"repeated": 0.0},
    ("Map", 5): {"loop_closed": 0},
    ("Correction", 2): {"aligned": np.zeros((0, 6))},  # in the place of a field that there is no more
    ("Building", 1): {"doubts": np.zeros((0, 3))},
}
# likewise -> the columns of keyframes that it lacks, each a copy of the column `covariance`, or zeros of this shape wherever that changes
ADDED_COLUMNS: dict[tuple[str, int], dict[str, tuple[int, ...] | None]] = {
    ("Map", 4): {"world_covariance": None},
    ("Map", 6): {"sensitivity": (6, CALIBRATION), "twist": (6,)},
    ("Map", 8): {"aligned": (6,), "undone": (6,), "undone_sensitivity": (6, CALIBRATION)},
}

# likewise -> the tables that it lacks, empty wherever that type is recorded
ADDED_TABLES: dict[tuple[str, int], dict[str, Columns]] = {("Map", 7): {"proposals": PROPOSALS}}

_Schema = tuple[str, str, bytes, str]  # name, encoding, content, and the encoding of its messages


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
        raise damaged_file_error(source)
    unreadable = _unreadable(file, rename=True)
    result = Upgraded(skipped={file.channels[channel].topic: why for channel, why in unreadable.items()})
    if f"/{FRAMES_TOPIC}" in result.skipped:
        raise RecordingError(str(source), f"cannot be upgraded: {result.skipped[f'/{FRAMES_TOPIC}']}", "record it again")
    with new_recording(destination, "give another DST.mcap") as new:
        writer = McapWriter(new)
        try:
            _copy(file, writer, unreadable, result)
        finally:
            writer.close()
    return result


def _copy(file: McapFile, writer: McapWriter, unreadable: dict[int, str], result: Upgraded) -> None:
    writer.metadata(METADATA, {**file.metadata[METADATA], "format": FORMAT})
    for name, data in file.attachments.items():
        writer.attach(name, data.decode("utf-8", "replace"))
    numbers: dict[str, int] = {}
    codecs: dict[int, tuple[Decoder, Encoder]] = {}
    for channel, log_time, data in file.messages():
        if channel in unreadable:
            continue
        for topic, described, content in _of_today(file, channel, data, codecs):
            if topic not in numbers:
                numbers[topic] = writer.channel(topic, *described)
            writer.add(len(content), partial(list, [(numbers[topic], log_time, content)]))
        result.messages += 1


def _of_today(file: McapFile, channel: int, data: bytes, codecs: dict[int, tuple[Decoder, Encoder]]) -> Iterator[tuple[str, _Schema, bytes]]:
    """The messages that take the place of one: channel, schema, content."""
    declared, schema = file.channels[channel], file.schemas.get(file.channels[channel].schema_id)
    if _is_value(file, channel):
        decoder, encoder = codecs.setdefault(channel, (_decoder(file, channel), Encoder()))
        value = decoder.decode(_rename_fields(data))
        if isinstance(value, Frame):
            for part, message in messages_of(value):
                definition = build_file_descriptor_set(type(message)).SerializeToString()
                described = (message.DESCRIPTOR.full_name, "protobuf", definition, "protobuf")
                yield declared.topic + part, described, message.SerializeToString()
        else:
            yield declared.topic, _schema_of(type(value).__name__), encoder.encode(value)
    elif declared.topic == TIMING_TOPIC:
        yield declared.topic, _schema_of("Timing"), bytes(message_class("Timing")(**timing_of(data)).SerializeToString())
    else:
        described = (schema.name, schema.encoding, schema.data, declared.message_encoding) if schema is not None else ("", "", b"", "")
        yield declared.topic, described, data


def _schema_of(name: str) -> _Schema:
    return f"{PACKAGE}.{name}", "protobuf", definition(name), "protobuf"


def _unreadable(file: McapFile, rename: bool) -> dict[int, str]:
    """The channels of values whose first message cannot be decoded, and why."""
    causes: dict[int, str] = {}
    for channel in file.channels:
        chunks = file.chunks(channel) if _is_value(file, channel) else []
        for _, data in file.in_chunk(chunks[0], channel)[:1] if chunks else ():
            try:
                _decoder(file, channel).decode(_rename_fields(data) if rename else data)
            except RecordingError as error:
                causes[channel] = error.cause
    return causes


def _is_value(file: McapFile, channel: int) -> bool:
    return is_value_schema(file.schema_name(channel))


def _decoder(file: McapFile, channel: int) -> Decoder:
    return Decoder(f"{file.path}: topic {printable(file.channels[channel].topic, 80)}")


def _rename_fields(data: bytes) -> bytes:
    """A message with the names, fields and columns of today."""
    message = LegacyMessage.FromString(data)
    if not message.arrays:
        return _add_to_message(message, data)
    message.type = RENAMED_TYPES.get(message.type, message.type)
    fields, older = RENAMED_FIELDS.get(message.type, {}), (message.type, message.version)
    added = older in ADDED_FIELDS or older in ADDED_COLUMNS or older in ADDED_TABLES
    if not fields and not added:
        return data
    for array in message.arrays:
        name, mark, rest = array.name.partition("#")
        array.name = fields.get(name, name) + mark + rest
    if older in ADDED_COLUMNS:
        with suppress(Exception):  # a stranger's header, of which the decoder will say what is wrong
            keyframes = next(array for array in message.arrays if array.name == "keyframes#")
            for column, shape in ADDED_COLUMNS[older].items():
                keyframes.data = _add_keyframe_column(keyframes.data, message.arrays, "keyframes#", column, shape).encode()
    if not added:
        return bytes(message.SerializeToString())
    message.version += 1
    for name, columns in ADDED_TABLES.get(older, {}).items():
        message.arrays.add(name=f"{name}#", dtype="str", encoding="raw", data=_empty_layout(columns).encode())
    for name, value in ADDED_FIELDS.get(older, {}).items():
        array = np.asarray(value)
        kind = array.dtype.str.lstrip("<") if array.ndim else type(value).__name__
        message.arrays.add(name=name, dtype=kind, shape=array.shape, encoding="raw", data=array.tobytes())
    return _rename_fields(bytes(message.SerializeToString()))  # which may be an older version still


def _add_to_message(header: Any, data: bytes) -> bytes:
    """A message of a schema of its own with the fields, columns and empty tables that its version lacks."""
    older = header.type, header.version
    if older not in ADDED_TABLES and older not in ADDED_FIELDS and older not in ADDED_COLUMNS:
        return data
    with suppress(Exception):  # a damaged message or a stranger's, of which the decoder will say what is wrong
        message = message_class(header.type).FromString(data)
        message.version += 1
        for name, columns in ADDED_TABLES.get(older, {}).items():
            getattr(message, name).layout = _empty_layout(columns)
        for name, value in ADDED_FIELDS.get(older, {}).items():
            _set_field(message, name, value)
        for column, shape in ADDED_COLUMNS.get(older, {}).items():
            message.keyframes.layout = _add_keyframe_column(message.keyframes.layout, message.keyframes.arrays, "", column, shape)
        return _rename_fields(bytes(message.SerializeToString()))  # which may be an older version still
    return data


def _set_field(message: Any, name: str, value: Any) -> None:
    """Set a number, or an array as the codec writes it."""
    if np.ndim(value) == 0:
        setattr(message, name, value)
        return
    found = getattr(message, name)
    found.dtype, found.encoding, found.data = value.dtype.str.lstrip("<"), "raw", value.tobytes()
    found.shape[:] = value.shape


def _empty_layout(columns: Columns) -> str:
    """The layout of an empty table (see `table_codec`)."""
    return json.dumps({"size": 0, "back": 0, "schema": {name: [kind, shape, 0.0] for name, (kind, shape, *_) in columns.columns.items()}, "rows": {}})


def _add_keyframe_column(layout: str | bytes, arrays: Any, prefix: str, column: str, shape: tuple[int, ...] | None) -> str:
    """Add a column to the table of keyframes, or to a change of it: a copy of `covariance`, or zeros of a shape. Names of its `arrays` have a prefix.
    Returns the layout."""
    header = json.loads(layout)
    if "covariance" in header["schema"]:
        kind, source_shape, step = header["schema"]["covariance"]
        header["schema"][column] = [kind, source_shape if shape is None else shape, step]
    if "covariance" in header["schema"] and "covariance" in header["rows"]:
        header["rows"][column] = header["rows"]["covariance"]
        source = next(array for array in arrays if array.name == f"{prefix}covariance")
        copied = arrays.add()
        copied.CopyFrom(source)
        copied.name = f"{prefix}{column}"
        if shape is not None:
            zeros = np.zeros((source.shape[0], *shape))
            del copied.shape[:]
            copied.shape.extend(zeros.shape)
            copied.encoding, copied.data = "raw", zeros.tobytes()
    return json.dumps(header)
