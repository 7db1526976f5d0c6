"""Random changes of a file: what the fuzzer gives to a reader."""

from __future__ import annotations

from io import BytesIO

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

MAGIC_NUMBERS = [0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1]
WORDS = [
    b"nan",
    b"inf",
    b"-inf",
    b"1e400",
    b"-1",
    b"0",
    b"9" * 400,
    b"#",
    b",",
    b"\n",
    b"\x00",
    b"\xff",
    b"../../etc/passwd",
    b"1e-400",
    b"!!python/object:os.system",
]


def changed(data: bytes, others: list[bytes], rng: np.random.Generator) -> bytes:
    """One to four random changes."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at, length = int(rng.integers(0, len(out) + 1)), int(rng.integers(1, 33))
        kind = int(rng.integers(0, 9))
        if kind == 0 and at < len(out):
            out[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1 and at < len(out):
            out[at] = int(rng.integers(0, 256))
        elif kind == 2:
            del out[at : at + length]
        elif kind == 3:
            out[at:at] = out[at : at + length] * int(rng.integers(1, 4))
        elif kind == 4:
            other = others[int(rng.integers(0, len(others)))]
            begin = int(rng.integers(0, len(other) + 1))
            out[at : at + length * int(rng.integers(0, 2))] = other[begin : begin + length]
        elif kind == 5:
            size, number = int(rng.choice([1, 2, 4, 8])), MAGIC_NUMBERS[int(rng.integers(0, len(MAGIC_NUMBERS)))]
            out[at : at + size] = (number & ((1 << 8 * size) - 1)).to_bytes(size, "little" if rng.random() < 0.7 else "big")
        elif kind == 6:
            word = WORDS[int(rng.integers(0, len(WORDS)))]
            out[at : at + int(rng.integers(0, 4))] = word
        elif kind == 7 and rng.random() < 0.3:
            del out[at:]
        elif kind == 8:
            out[at : at + length] = rng.bytes(length)
    return bytes(out)


def changed_inside(data: bytes, others: list[bytes], rng: np.random.Generator) -> bytes:
    """An MCAP file with one of its messages, or what is said of its channels, changed, packed again so that everything about it fits."""
    target = BytesIO()
    reader = make_reader(BytesIO(data))
    writer = Writer(target, compression=list(CompressionType)[int(rng.integers(0, len(CompressionType)))], chunk_size=int(rng.integers(500, 20_000)))
    writer.start()
    for metadata in reader.iter_metadata():
        texts = metadata.metadata
        if rng.random() < 0.1 and texts:
            key = sorted(texts)[int(rng.integers(0, len(texts)))]
            texts[key] = changed(texts[key].encode(), others, rng).decode("utf-8", "replace")
        writer.add_metadata(metadata.name, texts)
    for attachment in reader.iter_attachments():
        writer.add_attachment(
            0, 0, attachment.name, attachment.media_type, changed(attachment.data, others, rng) if rng.random() < 0.2 else attachment.data
        )
    stored = list(reader.iter_messages(log_time_order=False))
    chosen = {int(rng.integers(0, len(stored)))}
    channels: dict[int, int] = {}
    for row, (schema, channel, sent) in enumerate(stored):
        if channel.id not in channels:
            assert schema is not None
            kind = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, kind)
        content = changed(sent.data, others, rng) if row in chosen else sent.data
        writer.add_message(channels[channel.id], sent.log_time, content, sent.publish_time)
    writer.finish()
    return target.getvalue()
