"""Files that claim more than they hold: each is refused with one line, before memory or work is spent on the claim."""

import tracemalloc
import zlib
from contextlib import suppress

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import RecordingError, printable
from trihedron.pipeline.record.codec import FORMAT, METADATA
from trihedron.pipeline.record.mcap_file import McapFile
from trihedron.pipeline.record.reader import Recording

TOPIC = Channel(1, "/pose", "protobuf", {}, 1)
CURE = "rescue what is whole with: trihedron recover "
SCHEMA = Schema(1, b"", "protobuf", "trihedron.Value")


def bytes_of(*records):
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def messages(count, size):
    """The plain content of a chunk, and where its messages begin."""
    data, offsets = bytes_of(SCHEMA, TOPIC), []
    for k in range(count):
        offsets.append(len(data))
        data += bytes_of(Message(1, k, bytes(size), k, 0))
    return data, offsets


def file_of(path, plain, entries, *, packed=None, claimed=None, compression="", repeat=1, extra=(), crc=True, length=None):
    """A recording with one chunk, whose index holds these (time, offset) entries; the chunk is named `repeat` times."""
    packed = plain if packed is None else packed
    claimed = len(plain) if claimed is None else claimed
    metadata = Metadata(METADATA, {"format": FORMAT})
    data = MCAP0_MAGIC + bytes_of(Header("", "x"))
    at = len(data)
    data += bytes_of(metadata)
    indexes = [MetadataIndex(at, len(data) - at, METADATA)]
    begin = len(data)
    data += bytes_of(Chunk(compression, packed, 10, 0, zlib.crc32(plain) if crc else 0, claimed))
    chunk_length, index_at = len(data) - begin, len(data)
    data += bytes_of(MessageIndex(1, entries))
    offsets = {1: index_at}
    chunk = ChunkIndex(length or chunk_length, begin, compression, len(packed), 10, len(data) - index_at, offsets, 0, claimed)
    for record in extra:
        at = len(data)
        data += bytes_of(record)
        indexes += [AttachmentIndex(at, len(data) - at, 0, 0, len(record.data), record.name, "") for _ in range(50_000)]
    data += bytes_of(DataEnd(0))
    start = len(data)
    data += bytes_of(SCHEMA, TOPIC, *[chunk] * repeat, *indexes, Statistics(0, 1, {1: len(entries)}, 1, len(entries), 10, 0, 1, 1))
    path.write_bytes(data + bytes_of(Footer(start, 0, 0)) + MCAP0_MAGIC)
    return path


def refused(path, capsys, cause):
    """Check that reading the file takes under 200 MB, hands out no message, and raises this cause; returns the cure of the one line printed."""
    handed_out = []
    tracemalloc.start()
    try:
        with pytest.raises(RecordingError, match=cause):
            handed_out.extend(Recording(path).values("pose"))
        with suppress(RecordingError):
            handed_out.extend(McapFile(path).messages())
        assert handed_out == [] and main(["topics", str(path)]) == 1
        assert tracemalloc.get_traced_memory()[1] < 200e6
    finally:
        tracemalloc.stop()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith(f"trihedron: {path}: ") and len(lines[0]) < 1000
    return lines[0].rpartition("; ")[2]


def test_the_file_itself_is_read(tmp_path):
    plain, offsets = messages(3, 100)
    file = McapFile(file_of(tmp_path / "a.mcap", plain, [(k, offset) for k, offset in enumerate(offsets)]))
    assert [(channel, log_time, len(data)) for channel, log_time, data in file.messages()] == [(1, 0, 100), (1, 1, 100), (1, 2, 100)]


@pytest.mark.parametrize("compression, pack", [("zstd", zstandard.compress), ("lz4", lz4.frame.compress)])
@pytest.mark.parametrize("honest", [True, False])
def test_a_chunk_of_a_gigabyte_in_some_kilobytes(tmp_path, capsys, compression, pack, honest):
    packed = pack(bytes(1 << 27)) if compression == "lz4" else zstandard.ZstdCompressor().compress(bytes(1 << 30))
    path = file_of(tmp_path / "a.mcap", b"", [(0, 0)], packed=packed, claimed=1 << 30 if honest else 1000, compression=compression, crc=False)
    assert refused(path, capsys, "is damaged").startswith(CURE)


def test_an_index_that_names_one_message_again_and_again(tmp_path, capsys):
    plain, offsets = messages(1, 1_000_000)
    assert refused(file_of(tmp_path / "a.mcap", plain, [(0, offsets[0])] * 50_000), capsys, "names a message twice").startswith(CURE)


def test_messages_within_a_message(tmp_path, capsys):
    """Fifty thousand offsets, each with a header whose length reaches to the end of the chunk."""
    head, count = bytes_of(Message(1, 0, b"", 0, 0)), 50_000
    plain = b"".join(head[:1] + ((count - k) * len(head) - 9).to_bytes(8, "little") + head[9:] for k in range(count))
    assert refused(file_of(tmp_path / "a.mcap", plain, [(0, k * len(head)) for k in range(count)]), capsys, "asks for").startswith(CURE)


def test_chunks_and_attachments_that_are_named_again_and_again(tmp_path):
    """Such an index is not used: the file is gone through, and is no recording."""
    plain, offsets = messages(1, 1000)
    many = file_of(tmp_path / "b.mcap", plain, [(0, offsets[0])], extra=[Attachment(0, 0, "a", "", bytes(1_000_000))])
    for path in (file_of(tmp_path / "a.mcap", plain, [(0, offsets[0])], repeat=50_000), many):
        with pytest.raises(RecordingError, match="is damaged; rescue what is whole with: trihedron recover"):
            Recording(path)
        assert len(list(McapFile(path).messages())) == 1


def test_an_index_of_another_chunk_time_or_channel(tmp_path, capsys):
    plain, offsets = messages(2, 10)
    assert refused(file_of(tmp_path / "a.mcap", plain, [(5, offsets[0])]), capsys, "names a place where none of its messages is").startswith(CURE)
    assert refused(file_of(tmp_path / "b.mcap", plain, [(0, 1 << 63)]), capsys, "leads out of its chunk").startswith(CURE)
    assert refused(file_of(tmp_path / "c.mcap", plain, [(0, offsets[0])], length=50), capsys, "not beside its chunk").startswith(CURE)


def test_what_files_hold_is_printed_as_one_bounded_line():
    assert printable("/\x1b[2J\r\n\u202eé") == "/?[2J???é"
    assert printable("x" * 300, 10) == "x" * 9 + "…"
    error = RecordingError("a.mcap", "holds\x1b]0;title\x07" + 10_000 * "x", "record it again")
    assert str(error).startswith("a.mcap: holds?]0;title?xxx") and len(str(error)) == 4000


def test_a_file_without_index_whose_chunks_hold_too_many_messages(tmp_path):
    """A million messages in a few kilobytes: it is read up to the limit, and is not complete."""
    plain = bytes_of(SCHEMA, TOPIC) + bytes_of(Message(1, 0, b"", 0, 0)) * 1_000_000
    data = MCAP0_MAGIC + bytes_of(Header("", "x"), Chunk("zstd", zstandard.compress(plain), 0, 0, 0, len(plain)))
    (tmp_path / "a.mcap").write_bytes(data)
    file = McapFile(tmp_path / "a.mcap")
    assert not file.complete and 200_000 <= len(file.locate(1)) < 210_000
