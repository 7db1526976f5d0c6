"""`trihedron topics`: what a file holds, and one clear line for one that is damaged."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

import trihedron as th
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.types import Camera, Frame, FrameReference
from trihedron.pipeline.record.writer import RecordingWriter

CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
CUT = "is not a complete MCAP file: what wrote it was cut off; rescue what is whole with: trihedron recover"


@pytest.fixture
def recording(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap", {"version": "1"})
    for index in range(3):
        writer.write("frames", FrameReference(index, 1_000_000_000 + index * 500_000_000, CAMERA))
        writer.write_timing(index, 1_000_000_000 + index * 500_000_000, 10.0, {"pose": 1.0}, 250.0)
    writer.close()
    return tmp_path / "run.mcap"


def test_our_own_recording(recording, capsys):
    assert main(["topics", str(recording)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["topic", "schema", "messages", "first", "(s)", "last", "(s)", "bytes"]
    rows = [line.split() for line in lines[1:]]
    assert [row[:5] for row in rows] == [
        ["/frames", "trihedron.FrameReference", "3", "1.000000", "2.000000"],
        ["/timing", "trihedron.Timing", "3", "1.000000", "2.000000"],
    ]
    assert all(int(row[5]) > 30 for row in rows)


def test_a_file_of_another_program(tmp_path, capsys):
    with open(tmp_path / "other.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/odom", "json", 0)
        for stamp in (7_000_000_000, 6_000_000_000):
            writer.add_message(channel, stamp, b"{}", stamp)
        writer.finish()
    assert main(["topics", str(tmp_path / "other.mcap")]) == 0
    assert capsys.readouterr().out.splitlines()[1].split() == ["/odom", "json", "2", "6.000000", "7.000000", "4"]


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.99])
def test_a_truncated_file(recording, capsys, share):
    data = recording.read_bytes()
    recording.write_bytes(data[: int(share * len(data))])
    assert main(["topics", str(recording)]) == 1
    assert capsys.readouterr().err == f"trihedron: {recording}: {CUT} {recording}\n"


def test_damage_in_the_middle(recording, capsys):
    data = bytearray(recording.read_bytes())
    data[len(data) // 3 : len(data) // 3 + 200] = bytes(200)
    recording.write_bytes(data)
    assert main(["topics", str(recording)]) == 1
    line = capsys.readouterr().err
    assert line.startswith(f"trihedron: {recording}: channel /") and line.endswith(f"; rescue what is whole with: trihedron recover {recording}\n")


def test_escape_codes_in_names_do_not_reach_the_terminal(tmp_path, capsys):
    with open(tmp_path / "hostile.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/\x1b]0;title\x07" + 500 * "x", "json", writer.register_schema("\x1b[2J", "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    assert main(["topics", str(tmp_path / "hostile.mcap")]) == 0
    name, schema, *_ = capsys.readouterr().out.splitlines()[1].split()
    assert name == "/?]0;title?" + 108 * "x" + "…" and schema == "?[2J"


def test_other_files(tmp_path, capsys):
    (tmp_path / "text.mcap").write_text("no recording")
    assert main(["topics", str(tmp_path / "text.mcap")]) == 1
    line = f"trihedron: {tmp_path / 'text.mcap'}: is not an MCAP file; give a file that trihedron run or another MCAP writer wrote\n"
    assert capsys.readouterr().err == line
    missing = tmp_path / "none.mcap"
    assert main(["topics", str(missing)]) == 1
    assert capsys.readouterr().err == f"trihedron: {missing}: cannot be read: No such file or directory; give the path of an MCAP file\n"
    assert main(["topics"]) == 2
    assert capsys.readouterr().err == "trihedron: topics: the following arguments are required: FILE.mcap; see trihedron topics --help\n"


def test_a_file_that_is_still_being_written(tmp_path, capsys):
    path, camera = tmp_path / "run.mcap", Camera(32, 32, 30.0, 30.0, 15.5, 15.5)
    writer = RecordingWriter(path, {"overrides": "[]"})
    for index in range(3):
        writer.write("frames", FrameReference(index, 1000 * index, camera))
        writer.write("dataset", Frame(index, 1000 * index, np.full((32, 32, 3), index, np.uint8), np.full((32, 32), 0.1, np.float32), camera))
    writer.flush()
    assert main(["topics", str(path)]) == 0
    assert [line.split()[:3] for line in capsys.readouterr().out.splitlines()[1:]] == [
        ["/dataset/color", "foxglove.CompressedImage", "3"],
        ["/dataset/depth", "foxglove.RawImage", "3"],
        ["/frames", "trihedron.FrameReference", "3"],
    ]
    run = th.Recording(path)
    assert run.frames == (0, 1, 2) and [value.color[0, 0, 0] for value in run.values("dataset")] == [0, 1, 2]
    capsys.readouterr()
    assert main(["export", str(path), "--to", "csv"]) == 1
    assert capsys.readouterr().err.splitlines() == [
        f"trihedron: {path} is still being written; its first 9 messages are read",
        f"trihedron: {path}: holds no poses; record a run with 'outputs=[trajectory]'",
    ]
    writer.close()
    assert th.Recording(path).frames == (0, 1, 2) and capsys.readouterr().err == ""


def test_the_folder_of_a_run_stands_for_its_recording(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    shutil.copy(Path(__file__).parents[1] / "fuzz" / "seeds" / "own.mcap", tmp_path / "run" / "run.mcap")
    printed = []
    for words in (["topics", "run"], ["topics", "run/run.mcap"], ["diff", "run", "run/run.mcap"]):
        assert main([words[0], *(str(tmp_path / word) for word in words[1:])]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] and printed[2].startswith("equal: ")
    (tmp_path / "empty").mkdir()
    assert main(["topics", str(tmp_path / "empty")]) == 1
    cause = "cannot be read: No such file or directory; give the path of an MCAP file"
    assert capsys.readouterr().err == f"trihedron: {tmp_path}/empty/run.mcap: {cause}\n"
