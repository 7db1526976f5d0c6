"""Well-formed files whose values are extreme: what the fuzzer gives to a reader beside changed bytes.

Each function makes one input out of a parsed seed. It goes through the first checks of its format (protobuf, JSON, YAML, PNG, CDR, the records and
chunks of MCAP, the columns of a list), so that those behind are reached.
"""

from __future__ import annotations

import json
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from io import BytesIO
from typing import Any

import numpy as np
import yaml
from changes import changed
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from trihedron.datasets.readers import foxglove_messages
from trihedron.datasets.readers.robot_streams import ROS

Rng = np.random.Generator
INTEGERS = [0, 1, -1, 2, 7, 63, 64, 65, 255, 256, 4096, 2**15, 2**24, 2**31 - 1, 2**31, -(2**31), 2**32 - 1, 2**53, 2**62, 2**63 - 1, -(2**63)]
FLOATS = [0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 5e-324, 1e-9, 1e9, 1e38, 1e39, 1e308, -1e308, float("inf"), -float("inf"), float("nan"), 2.0**63]
TEXTS = ["", " ", "\t", "\n", "0", "-", ".", "..", "/", "~", "~nobody/x", "/dev/zero", "../../x", "²", "9" * 19, "9" * 5000, "1e999", "nan", "null"]
TEXTS += [
    "\x1b[2J\x1b]0;x\x07",
    "\u202e",
    "é",
    "日本",
    "\x00",
    "a b",
    "a,b",
    "a=b",
    "'",
    '"',
    "${oc.env:HOME}",
    "x" * 70_000,
    "16UC1",
    "32FC1",
    "rgb8",
]
TEXTS += [
    "mono16",
    "bgra8",
    "png",
    "jpeg",
    "16UC1; compressedDepth png",
    "zstd",
    "rows",
    "columns",
    "f8",
    "?",
    "O",
    "V8",
    "M8[ns]",
    "i8",
    "str",
    "float",
]
NUMBERS = [
    "0",
    "-0",
    "1",
    "-1",
    "1e999",
    "-1e999",
    "1e-999",
    "nan",
    "inf",
    "9" * 19,
    "9" * 400,
    "1_000",
    "0x10",
    "²",
    "٣",
    "1e308",
    "4.9e-324",
    "+1",
    "1.",
]
YAML = [
    "2024-13-45",
    "!!int x",
    "9" * 5000,
    "!!python/object/apply:os.system [id]",
    "[" * 2000,
    "{a: " * 500,
    "&a [*a]",
    "*b",
    "<<: *a",
    "!!binary x",
    "? a",
]
YAML += [
    ".inf",
    ".nan",
    "0o17",
    "0b1",
    "1:30:00",
    "!!timestamp x",
    "!!float x",
    "!!set {a}",
    "~",
    "yes",
    "|\n x",
    "''",
    '"\\x1b[2J"',
    "- 1",
    "%TAG ! x",
]
STORE = get_typestore(Stores.ROS2_HUMBLE)


def pick(choices: Any, rng: Rng) -> Any:
    """One of them."""
    return choices[int(rng.integers(0, len(choices)))]


# Texts: lists, poses, matrices, OBJ.


def words(data: bytes, rng: Rng) -> bytes:
    """Lines of words by blanks, some of which become extreme numbers and texts; lines double, and move."""
    lines = data.decode("utf-8", "replace").splitlines()
    for _ in range(int(rng.integers(1, 6))):
        row = int(rng.integers(0, max(len(lines), 1)))
        parts = re.split(r"([\s,]+)", lines[row]) if lines else [""]
        kind = rng.random()
        if kind < 0.6:
            parts[2 * int(rng.integers(0, len(parts) // 2 + 1))] = pick(NUMBERS if rng.random() < 0.7 else TEXTS, rng)
        elif kind < 0.7:
            parts += [" ", pick(NUMBERS, rng)]
        elif kind < 0.8:
            parts = parts[:-2]
        elif kind < 0.9 and lines:
            lines.insert(int(rng.integers(0, len(lines))), lines[row])
        elif sum(map(len, lines)) < 10_000:
            lines = lines[: row + 1] + lines[row:] * int(rng.integers(1, 200))
        if lines:
            lines[row] = "".join(parts)
    return "\n".join(lines).encode("utf-8", "replace")


# JSON and YAML.


def tree(value: Any, rng: Rng) -> Any:
    """A value of JSON with one of its parts replaced."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = pick(sorted(value), rng)
        kind = rng.random()
        if kind < 0.1:
            return {name: item for name, item in value.items() if name != key}
        if kind < 0.2:
            return {**value, pick(TEXTS, rng): value[key]}
        return {**value, key: tree(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.85:
        at = int(rng.integers(0, len(value)))
        kind = rng.random()
        if kind < 0.2:
            return value[:at] + value[at + 1 :] if kind < 0.1 else value + value[at:] * int(rng.integers(1, 50))
        return [*value[:at], tree(value[at], rng), *value[at + 1 :]]
    kind = rng.random()
    if kind < 0.35:
        return pick(INTEGERS, rng)
    if kind < 0.6:
        return pick(FLOATS, rng)
    return pick(TEXTS, rng) if kind < 0.85 else pick([None, True, [], {}, [value], {"a": value}, [[]] * 70, [2**62] * 20, "RAW"], rng)


RAW_JSON = [
    "1e999",
    "-1e999",
    "[" * 50_000,
    '{"a":' * 50_000,
    "9" * 5000,
    "NaN",
    "-Infinity",
    '"\\ud800"',
    "01",
    "[1,]",
    "1e-400",
    "[" * 900 + "]" * 900,
]


def json_text(data: bytes, rng: Rng) -> bytes:
    """JSON with parts replaced, in places by what only the text can say."""
    value = json.loads(data)
    for _ in range(int(rng.integers(1, 4))):
        value = tree(value, rng)
    return json.dumps(value).replace('"RAW"', pick(RAW_JSON, rng), 1).encode("utf-8", "surrogatepass")


def yaml_text(data: bytes, rng: Rng) -> bytes:
    """A mapping with parts replaced, in places by what only the text can say."""
    value = yaml.safe_load(data)
    for _ in range(int(rng.integers(1, 4))):
        value = tree(value, rng)
    if isinstance(value, dict) and rng.random() < 0.5:
        value[pick(sorted(value, key=str) or [""], rng)] = "RAW"
    text = yaml.safe_dump(value, default_flow_style=bool(rng.random() < 0.3), allow_unicode=True, sort_keys=False, width=10**6)
    return text.replace("RAW", pick(YAML, rng), 1).encode("utf-8", "surrogatepass")


# Images.


def png(rng: Rng) -> bytes:
    """A PNG of right chunks and checksums: any size, depth and colour type, with all, some or far more of its pixels."""
    width, height = (int(pick([0, 1, 2, 3, 16, 17, 640, 2**15, 2**16, 2**31 - 1, 2**32 - 1], rng)) for _ in range(2))
    depth, color, interlace = pick([1, 2, 4, 8, 16, 3, 0], rng), pick([0, 2, 3, 4, 6, 1], rng), pick([0, 0, 0, 1, 2], rng)
    plain = bytes(min((width * 8 + 1) * height, int(pick([0, 10, 1000, 100_000, 30_000_000], rng))))
    parts = [(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, interlace))]
    extra = [(b"PLTE", bytes(3 * int(rng.integers(0, 300)))), (b"gAMA", struct.pack(">I", pick([0, 1, 2**31], rng)))]
    extra += [
        (b"tRNS", bytes(int(rng.integers(0, 300)))),
        (b"zTXt", b"a\0\0" + zlib.compress(bytes(20_000_000), 1)),
        (b"iCCP", b"a\0\0" + zlib.compress(plain)),
    ]
    extra += [(b"eXIf", b"II*\0\xff\xff\xff\xff"), (b"acTL", bytes(8))]
    parts += [pick(extra, rng) for _ in range(int(rng.integers(0, 3)))]
    parts += [(b"IDAT", zlib.compress(plain, 1))] * int(rng.integers(0, 3)) + [(b"IEND", b"")] * int(rng.integers(0, 2))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in parts
    )


def pnm(rng: Rng) -> bytes:
    """A PNM header of any numbers and blanks, and some pixels."""
    sizes = [pick(["0", "1", "2", "16", "65535", "65536", "-1", "9" * 19, "9" * 5000, "x", "²", "1.5", ""], rng) for _ in range(3)]
    blank = pick([" ", "\n", " " * 5000, "\n#" + "c" * 1000 + "\n", "#\n" * 500, "\t\v", ""], rng)
    return f"P{rng.integers(0, 9)}{blank}{blank.join(sizes)}\n".encode() + bytes(int(pick([0, 10, 1000, 100_000], rng)))


def tiff(rng: Rng) -> bytes:
    """A TIFF of one directory of common tags, each with numbers of any size."""
    order = pick("<>", rng)
    known = {256: 16, 257: 12, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: 12, 279: 192, 284: 1, 317: 1, 322: 16, 323: 16, 324: 8, 325: 256, 339: 1}
    tags = {
        tag: pick(INTEGERS, rng) & 0xFFFFFFFF if rng.random() < 0.15 else value for tag, value in known.items() if tag < 300 or rng.random() < 0.2
    }
    entries = [struct.pack(f"{order}HHII", tag, pick([3, 4, 4, 4, 16], rng), 1, value) for tag, value in sorted(tags.items())]
    head = struct.pack(f"{order}2sHI", b"II" if order == "<" else b"MM", 42, 8 + 192)
    return (
        head
        + bytes(192)
        + struct.pack(f"{order}H", pick([len(entries), len(entries), 65535, 0], rng))
        + b"".join(entries)
        + struct.pack(f"{order}I", 0)
    )


def bmp(rng: Rng) -> bytes:
    """A BMP header with any numbers."""
    width, height, bits = pick(INTEGERS, rng), pick(INTEGERS, rng), pick([0, 1, 4, 8, 16, 24, 32, 65535], rng)
    numbers = [number & 0xFFFFFFFF for number in (pick([0, 1, 2, 3], rng), pick(INTEGERS, rng), 0, 0, pick(INTEGERS, rng), 0)]
    body = struct.pack("<IIIHH6I", 40, width & 0xFFFFFFFF, height & 0xFFFFFFFF, 1, bits, *numbers)
    return b"BM" + struct.pack("<IHHI", 54 + 1000, 0, 0, pick([54, 0, 2**32 - 1], rng)) + body + bytes(1000)


def picture(data: bytes, rng: Rng) -> bytes:
    """An image of some format."""
    return bytes(pick([png, png, pnm, tiff, bmp], rng)(rng))


# Meshes.


def mesh(data: bytes, rng: Rng) -> bytes:
    """PLY with another header, or OBJ and ASCII PLY with other numbers."""
    head, mark, body = data.partition(b"end_header\n")
    if not mark or rng.random() < 0.4:
        return words(data, rng) if b"format binary" not in head else head + mark + changed(body, [body], rng)
    lines = head.decode().splitlines()
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(1, len(lines)))
        numbers = [pick(NUMBERS, rng), str(pick(INTEGERS, rng)), pick(TEXTS, rng).replace("\n", " ")]
        made = [
            f"element {pick(['vertex', 'face', 'edge'], rng)} {pick(numbers, rng)}",
            f"property {pick(['float', 'double', 'uchar', 'int8', 'x'], rng)} x",
        ]
        made += [f"property list {pick(['uchar', 'int', 'double', 'float'], rng)} {pick(['int', 'uint', 'float'], rng)} vertex_indices", lines[at]]
        made += [
            f"format {pick(['ascii', 'binary_little_endian', 'binary_big_endian', 'x'], rng)} 1.0",
            "comment " + pick(TEXTS, rng).replace("\n", " "),
            "",
        ]
        lines[at] = pick(made, rng)
    return "\n".join([*lines, "end_header\n"]).encode("utf-8", "replace") + body


# Protobuf, by its wire format alone; CDR of ROS, by its types.


def _varint(data: bytes, at: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte = data[at]
        number |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return number, at


def _packed(number: int) -> bytes:
    number &= 2**64 - 1
    digits = bytearray()
    while number > 0x7F:
        digits.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*digits, number])


def wire(data: bytes) -> list[tuple[int, int, Any]] | None:
    """(field, wire type, content) of a message, or None for what is none."""
    found, at = [], 0
    try:
        while at < len(data):
            tag, at = _varint(data, at)
            kind: int = tag & 7
            content: Any
            if kind == 0:
                content, at = _varint(data, at)
            elif kind in (1, 5):
                size = 8 if kind == 1 else 4
                content, at = data[at : at + size], at + size
            elif kind == 2:
                size, at = _varint(data, at)
                content, at = data[at : at + size], at + size
            else:
                return None
            if not tag >> 3 or at > len(data):
                return None
            found.append((tag >> 3, kind, content))
    except IndexError:
        return None
    return found


def unwire(message: list[tuple[int, int, Any]]) -> bytes:
    """The bytes of a message."""
    out = bytearray()
    for field, kind, content in message:
        out += _packed(field << 3 | kind) + (_packed(content) if kind == 0 else _packed(len(content)) + content if kind == 2 else content)
    return bytes(out)


def protobuf(data: bytes, rng: Rng) -> bytes:
    """A message with some of its fields, at any depth, extreme, doubled, moved or missing."""
    message = wire(data)
    if not message:
        return data
    for _ in range(int(rng.integers(1, 3))):
        at = int(rng.integers(0, len(message)))
        field, kind, content = message[at]
        choice = rng.random()
        if choice < 0.08:
            message.insert(int(rng.integers(0, len(message))), message[at])
        elif choice < 0.14 and len(message) > 1:
            message.pop(at)
        elif kind == 0:
            message[at] = (field, kind, int(pick(INTEGERS, rng)))
        elif kind != 2:
            message[at] = (
                field,
                kind,
                struct.pack("<d" if kind == 1 else "<I", pick(FLOATS, rng) if kind == 1 else pick(INTEGERS, rng) & 0xFFFFFFFF),
            )
        else:
            message[at] = (field, kind, _content(content, rng))
    return unwire(message)


def _content(content: bytes, rng: Rng) -> bytes:
    """Bytes, a text, packed numbers or a message, of which the wire does not say which."""
    choice = rng.random()
    if content[:1] == b"{" and choice < 0.8:
        try:
            return json_text(content, rng)
        except (ValueError, RecursionError):  # it is extreme already
            return content
    if choice < 0.6 and wire(content):
        return protobuf(content, rng)
    if choice < 0.75:
        return str(pick(TEXTS, rng)).encode("utf-8", "replace")
    if choice < 0.85:
        return b"".join(_packed(int(pick(INTEGERS, rng))) for _ in range(int(pick([0, 1, 2, 3, 8, 9, 65], rng))))
    if content and len(content) % 8 == 0 and choice < 0.93:
        numbers = bytearray(content)
        at = 8 * int(rng.integers(0, len(content) // 8))
        numbers[at : at + 8] = struct.pack("<d", pick(FLOATS, rng)) if rng.random() < 0.7 else struct.pack("<q", pick(INTEGERS, rng))
        return bytes(numbers)
    return content[: int(rng.integers(0, len(content) + 1))] if choice < 0.97 else content * int(rng.integers(2, 5))


def cdr(kind: str, data: bytes, rng: Rng) -> bytes:
    """A message of ROS with one or two of its fields extreme."""
    try:
        value = STORE.deserialize_cdr(data, kind)
        for _ in range(int(rng.integers(1, 3))):
            value = _ros_value(value, rng)
        return bytes(STORE.serialize_cdr(value, kind))
    except (OverflowError, struct.error, UnicodeError, ValueError, AssertionError, SerdeError):  # what this message cannot hold
        return changed(data, [data], rng)


def _ros_value(value: Any, rng: Rng) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value) if not field.name.startswith("__")]
        name = pick(names, rng) if names else ""
        return replace(value, **{name: _ros_value(getattr(value, name), rng)}) if names else value
    if isinstance(value, list):
        at = int(rng.integers(0, len(value))) if value else 0
        return pick([[*value[:at], _ros_value(value[at], rng), *value[at + 1 :]] if value else value, value[:at], value * 3], rng)
    if isinstance(value, np.ndarray):
        new = value[: int(rng.integers(0, len(value) + 1))] if rng.random() < 0.3 else value.copy()
        if len(new) and new.dtype.kind == "f":
            new[int(rng.integers(0, len(new)))] = pick(FLOATS, rng)
        return new
    if isinstance(value, str):
        return pick(TEXTS, rng)
    if isinstance(value, float):
        return pick(FLOATS, rng)
    return pick([number for number in INTEGERS if 0 <= number < 2**32], rng) if isinstance(value, int) else value


def message(data: bytes, rng: Rng) -> bytes:
    """A seed of a message, behind the byte that says of which type."""
    kinds: list[tuple[str, str]] = [(kind, "cdr") for kind in ROS]
    kinds += [(kind, encoding) for kind in foxglove_messages.READERS for encoding in ("protobuf", "json")] + [("trihedron.Value", "protobuf")]
    return data[:1] + content_of(*kinds[data[0] % len(kinds)], data[1:], rng)


def content_of(kind: str, encoding: str, data: bytes, rng: Rng) -> bytes:
    """A message of a type in an encoding."""
    if encoding == "cdr":
        return cdr(kind, data, rng) if kind in ROS else changed(data, [data], rng)
    return json_text(data, rng) if encoding == "json" else protobuf(data, rng)


# MCAP.


def recording(data: bytes, rng: Rng) -> bytes:
    """A file whose messages, metadata and attachments are extreme, packed so that all about them fits; else one whose records are."""
    if rng.random() < 0.3:
        return records(data, rng)
    target, reader = BytesIO(), make_reader(BytesIO(data))
    packing = pick(list(CompressionType), rng)
    writer = Writer(target, compression=packing, chunk_size=int(rng.integers(500, 20_000)), use_chunking=bool(rng.random() < 0.9))
    writer.start()
    for metadata in reader.iter_metadata():
        texts = dict(metadata.metadata)
        for key in sorted(texts):
            if rng.random() < 0.1:
                texts[key] = yaml_text(texts[key].encode(), rng).decode("utf-8", "replace") if key == "config" and texts[key] else pick(TEXTS, rng)
        writer.add_metadata(metadata.name, texts)
    for attachment in reader.iter_attachments():
        writer.add_attachment(0, 0, attachment.name, attachment.media_type, words(attachment.data, rng) if rng.random() < 0.2 else attachment.data)
    stored = list(reader.iter_messages(log_time_order=False))
    chosen = set(rng.integers(0, max(len(stored), 1), int(rng.integers(1, 4))).tolist())
    channels: dict[int, int] = {}
    for row, (schema, channel, sent) in enumerate(stored):
        assert schema is not None
        if channel.id not in channels:
            topic = pick(TEXTS, rng) if rng.random() < 0.02 else channel.topic
            channels[channel.id] = writer.register_channel(
                topic, channel.message_encoding, writer.register_schema(schema.name, schema.encoding, schema.data)
            )
        kept = row not in chosen or rng.random() < 0.1
        content = sent.data if kept else content_of(schema.name, channel.message_encoding, sent.data, rng)
        log_time = sent.log_time if rng.random() < 0.98 else pick([0, 1, 2**63 - 1, 2**63, 2**64 - 1], rng)
        writer.add_message(channels[channel.id], log_time, content, sent.publish_time)
    writer.finish()
    return target.getvalue()


def records(data: bytes, rng: Rng) -> bytes:
    """The records of a file, one or two of them with an extreme number or text, doubled, moved or missing."""
    found = list(StreamReader(BytesIO(data), emit_chunks=True, validate_crcs=False).records)
    for _ in range(int(rng.integers(1, 3))):
        at = int(rng.integers(0, len(found)))
        record, choice = found[at], rng.random()
        if choice < 0.1:
            found.insert(int(rng.integers(0, len(found))), record)
        elif choice < 0.2:
            found.pop(at)
        else:
            name = pick([field.name for field in fields(record)], rng)
            value = getattr(record, name)
            if isinstance(value, int):
                found[at] = replace(record, **{name: pick([number for number in INTEGERS if number >= 0], rng)})
            elif isinstance(value, str):
                found[at] = replace(record, **{name: pick(TEXTS, rng)})
            elif isinstance(value, dict) and all(isinstance(item, int) for item in value.values()):
                found[at] = replace(record, **{name: {key: pick(INTEGERS, rng) % 2**64 for key in value}})
    builder = RecordBuilder()
    try:
        for record in found:
            record.write(builder)
    except (struct.error, OverflowError):  # a number that its field cannot hold
        return changed(data, [data], rng)
    return MCAP0_MAGIC + builder.end() + MCAP0_MAGIC


STRUCTURED: dict[str, Callable[[bytes, Rng], bytes]] = {  # target -> its generator
    "lists": words, "associations": words, "cameras": yaml_text, "parameters": json_text, "trajectories": words, "matrices": words, "meshes": mesh,
    "pictures": picture, "messages": message, "recordings": recording, "frames": recording, "map": recording, "ros": recording,
    "foxglove": recording, "damaged": recording, "configurations": yaml_text,
}  # fmt: skip
