"""`trihedron convert`: frames and truth survive bit for bit, and every mistake is one line."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.registry import load_plugins, plugin_class
from trihedron.pipeline.core.types import CALIBRATION, Building, Camera, Correction, Pose
from trihedron.pipeline.record import upgrade
from trihedron.pipeline.record.codec import FORMAT, Encoder, LegacyMessage
from trihedron.pipeline.record.mcap_file import McapFile
from trihedron.pipeline.record.mcap_writer import McapWriter
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.schemas import message_class
from trihedron.pipeline.record.trajectories import read_trajectory
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.plugins.mapping.insertion import add_keyframe
from trihedron.plugins.mapping.landmarks import ALIGNMENT, empty_map

CAMERA = "width: 64\nheight: 48\nfx: 50.0\nfy: 50.0\ncx: 31.5\ncy: 23.5\ndepth_scale: 5000\nfps: 30\n"
COUNT = 12


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A data set of 12 random frames in the layout of the TUM benchmark, with truth for all."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    root = tmp_path / "room"
    for name in ("rgb", "depth"):
        (root / name).mkdir(parents=True)
    lists = {"rgb": "", "depth": "", "groundtruth": ""}
    for i in range(COUNT):
        stamp = f"{10 + i / 30:.6f}"
        cv2.imwrite(str(root / "rgb" / f"{i}.png"), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
        cv2.imwrite(str(root / "depth" / f"{i}.png"), rng.integers(1, 30_000, (48, 64), dtype=np.uint16))
        lists["rgb"] += f"{stamp} rgb/{i}.png\n"
        lists["depth"] += f"{stamp} depth/{i}.png\n"
        lists["groundtruth"] += f"{stamp} {0.1 * i} 0 0 0 0 0 1\n"
    for name, text in lists.items():
        (root / f"{name}.txt").write_text(text)
    (root / "camera.yaml").write_text(CAMERA)
    return root


def dataset(name, **options):
    load_plugins()
    return plugin_class("dataset", name)(**options)


def assert_same_frames(a, b, shift=0):
    assert len(a) == len(b)
    for i in range(len(a)):
        first, second = a(i), b(i)
        assert (first.stamp_ns, first.camera) == (second.stamp_ns, second.camera)
        assert first.color.tobytes() == second.color.tobytes()
        assert first.depth_m.tobytes() == second.depth_m.tobytes()
        assert second.index == first.index - shift


def test_folder_to_recording(folder, capsys):
    assert main(["convert", "room", "room.mcap"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("room.mcap: 12 frames, ")
    assert out.endswith(" MB\n")
    source, made = dataset("tum", path="room"), dataset("mcap", path="room.mcap")
    assert_same_frames(source, made)
    assert np.array_equal(made.truth().stamps_ns, source.truth().stamps_ns)
    assert np.allclose(made.truth().poses, read_trajectory("room/groundtruth.txt").poses, atol=1e-9)
    assert sorted(path.name for path in folder.parent.iterdir()) == ["room", "room.mcap"]


def test_part_of_a_recording(folder, capsys):
    assert main(["convert", "room", "room.mcap"]) == 0
    assert main(["convert", "room.mcap", "part.mcap", "--frames", "4:9"]) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("part.mcap: 5 frames, ")
    assert_same_frames(dataset("tum", path="room", frames="4:9"), dataset("mcap", path="part.mcap"), shift=4)


def test_layouts_are_recognised(folder, capsys):
    (folder / "rgb.txt").unlink()
    assert main(["convert", "room", "as_folder.mcap"]) == 0
    assert capsys.readouterr().out.startswith("as_folder.mcap: 12 frames, ")
    (folder / "associations.txt").write_text("".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(1, COUNT)))
    assert main(["convert", "room", "as_icl.mcap"]) == 0
    assert capsys.readouterr().out.startswith("as_icl.mcap: 11 frames, ")
    assert dataset("mcap", path="as_icl.mcap")(0).stamp_ns == 1_000_000_000


def test_an_unreadable_frame_is_skipped_and_counted(folder, capsys):
    (folder / "depth" / "5.png").write_bytes(b"\x89PNG")
    assert main(["convert", "room", "room.mcap"]) == 0
    assert capsys.readouterr().out.endswith(", 1 could not be read\n")
    assert dataset("mcap", path="room.mcap")(5).stamp_ns == 10_200_000_000


def test_a_replay_of_it_starts_from_its_frames(folder):
    (folder.parent / "it's here").mkdir()
    assert main(["convert", "room", "it's here/room.mcap"]) == 0
    place = str(folder.parent / "it's here" / "room.mcap").replace("'", "\\'")
    assert Recording("it's here/room.mcap").overrides() == ["dataset=mcap", f"dataset.path='{place}'"]


@pytest.mark.parametrize(
    ("words", "code", "line"),
    [
        (["room", "room.bag"], 2, "convert: 'room.bag' does not end in .mcap; give for example room.bag.mcap"),
        (["room", "there.mcap"], 2, "there.mcap: exists; give another name or --overwrite"),
        (["nowhere", "x.mcap"], 1, "nowhere: does not exist; give a folder, a .mcap, .bag or .r3d file"),
        (["room/rgb.txt", "x.mcap"], 1, "room/rgb.txt: is not a folder or a recording; give a folder, a .mcap, .bag or .r3d file"),
        (["there.mcap", "x.mcap"], 1, "there.mcap: is not an MCAP file; give a file that trihedron run or another MCAP writer wrote"),
        (["room", "x.mcap", "--frames=9:3"], 1, "--frames: '9:3' is not a range of frames A:B[:S] with A < B, S > 0; see trihedron convert --help"),
        (["room", "x.mcap", "--dataset", "tun"], 1, "dataset: there is no plugin 'tun' for the slot 'dataset'; did you mean 'tum'?"),
        (["room", "x.mcap", "--dataset", "scannet", "--camera", "a"], 1, "dataset=scannet: has no option 'camera'; leave out --camera"),
        (["room", "no/x.mcap"], 1, "no/x.mcap: cannot be written: No such file or directory; give another DST.mcap"),
    ],
)
def test_errors(folder, capsys, words, code, line):
    (folder.parent / "there.mcap").write_bytes(b"cut")
    assert main(["convert", *words]) == code
    assert capsys.readouterr().err == f"trihedron: {line}\n"
    assert not (folder.parent / "x.mcap").exists()


@pytest.mark.parametrize("form, messages, skipped", [(1, 21, ["map", "pose"]), (2, 3, ["bundle", "dataset", "map"])])
def test_a_recording_of_an_older_format_is_upgraded(form, messages, skipped, tmp_path, capsys):
    """Refused with the line that names `convert`; after it, what this program can read is there, and the rest is listed."""
    old, new = Path(__file__).parents[1] / "pipeline" / "recordings" / f"format_{form}.mcap", tmp_path / "new.mcap"
    assert main(["diff", str(old), str(old)]) == 1
    assert capsys.readouterr().err.endswith("upgrade what can be read of it with: trihedron convert SRC DST.mcap\n")
    assert main(["convert", str(old), str(new)]) == 0
    first, *rest = capsys.readouterr().out.splitlines()
    assert first.startswith(f"{new}: upgraded {messages} messages, ")
    assert [line.split(":")[0] for line in rest] == [f"  skipped /{topic}" for topic in skipped]
    recording = Recording(new)
    assert recording.metadata["format"] == FORMAT and not recording.topics & set(skipped)
    assert [value.index for value in recording.values("frames")] == [0, 1, 2]
    assert sum(recording.counts.values()) == messages and [path.name for path in tmp_path.iterdir()] == ["new.mcap"]


def test_renamed_types_and_fields_are_upgraded(tmp_path, monkeypatch, capsys):
    """A recording from before a renaming: the tables of `upgrade` carry it over, bit for bit."""
    old, new = Path(__file__).parents[1] / "pipeline" / "recordings" / "format_3.mcap", tmp_path / "new.mcap"
    before, expected = tmp_path / "before.mcap", tmp_path / "expected.mcap"
    assert main(["convert", str(old), str(expected)]) == 0
    write_renamed(old, before)
    monkeypatch.setattr(upgrade, "RENAMED_TYPES", {"LandmarkMap": "Map"})
    monkeypatch.setattr(upgrade, "RENAMED_FIELDS", {"Map": {"corners": "points", "number": "revision"}})
    assert main(["convert", str(before), str(new)]) == 0
    assert "upgraded 120 messages" in capsys.readouterr().out
    assert main(["diff", str(expected), str(new)]) == 0


@pytest.mark.parametrize(
    ("topic", "of", "older", "lacking"),
    [
        ("map", lambda index: empty_map(index, index, 32, 32, 8), "Map version 7, this program reads version 9", "proposals"),
        ("building", lambda index: Building.empty(index, index, "no plane was seen"), "Building version 1, this program reads version 2", "doubts"),
    ],
)
def test_a_value_without_a_later_field_is_upgraded(tmp_path, topic, of, older, lacking):
    """An older version of a type, of the recording's present format, lacks a table or an array, which is empty after it."""
    recorded, before, after = (tmp_path / f"{name}.mcap" for name in ("recorded", "before", "after"))
    writer = RecordingWriter(recorded, {})
    for index in range(3):
        writer.write(topic, of(index))
    writer.close()
    rewrite(recorded, before, partial(without, lacking, int(older.split()[2].rstrip(","))))
    with pytest.raises(RecordingError, match=f"holds {older}; upgrade"):
        list(Recording(before).values(topic))
    assert main(["convert", str(before), str(after)]) == 0
    expected, upgraded = (list(Recording(path).values(topic)) for path in (recorded, after))
    assert [Encoder().encode(value) for value in upgraded] == [Encoder().encode(value) for value in expected] and len(upgraded) == 3


def test_a_map_without_what_alignments_did_is_upgraded(tmp_path):
    """As version 8 of the map was, a snapshot and a change of it: no alignment has done anything to its keyframes."""
    ours, old, new = (tmp_path / f"{name}.mcap" for name in ("ours", "old", "new"))
    map, writer = empty_map(0, 0, 32, 32, 4), RecordingWriter(ours, {})
    camera = Camera(64, 48, 50.0, 51.0, 31.5, 23.5)
    for index in range(3):
        pose = Pose(index, index, np.eye(4), np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", "")
        map = replace(add_keyframe(map, pose, camera)[0], index=index, stamp_ns=index, revision=index)
        writer.write("map", map)
    writer.close()

    def without_alignments(data):
        message = message_class("Map").FromString(data)
        layout = json.loads(message.keyframes.layout)
        for name in ALIGNMENT:
            layout["schema"].pop(name), layout["rows"].pop(name)
        kept = [array for array in message.keyframes.arrays if array.name not in ALIGNMENT]
        assert len(kept) == len(message.keyframes.arrays) - len(ALIGNMENT)
        del message.keyframes.arrays[:]
        message.keyframes.arrays.extend(kept)
        message.keyframes.layout, message.version = json.dumps(layout), 8
        return message.SerializeToString()

    rewrite(ours, old, without_alignments)
    with pytest.raises(RecordingError, match="holds Map version 8, this program reads version 9"):
        list(Recording(old).values("map"))
    assert main(["convert", str(old), str(new)]) == 0
    for before, after in zip(Recording(ours).values("map"), Recording(new).values("map"), strict=True):
        assert before.keyframes.schema == after.keyframes.schema and len(before.keyframes) == before.index + 1
        assert all(np.array_equal(before.keyframes.column(name), after.keyframes.column(name)) for name in after.keyframes.schema)


def test_a_correction_with_a_field_that_there_is_no_more_is_upgraded(tmp_path):
    """As version 2 was: after the sensitivities came covariances, in the place of which are the motions of keyframes."""
    ours, old, new = (tmp_path / f"{name}.mcap" for name in ("ours", "old", "new"))
    none, writer = np.zeros((0, 3, 3)), RecordingWriter(ours, {})
    ids, bare = np.zeros(0, np.int32), none.astype(np.float32)
    keyframes = np.zeros(1, np.int32), np.eye(4)[None], np.ones((1, 6, CALIBRATION))
    lines, planes = (ids, np.zeros((0, 2, 3)), np.zeros((0, 2, 3, 3), np.float32)), (ids, np.zeros((0, 4)), none)
    writer.write("bundle", Correction(0, 0, 0, *keyframes[:2], ids, np.zeros((0, 3)), bare, *lines, *planes, sensitivity=keyframes[2]))
    writer.close()

    def with_covariance(data):
        message = message_class("Correction").FromString(data)
        message.aligned.shape[:], message.aligned.data, message.version = (1, 6, 6), np.eye(6).tobytes(), 2
        message.ClearField("undone"), message.ClearField("undone_sensitivity")
        return message.SerializeToString()

    rewrite(ours, old, with_covariance)
    assert main(["convert", str(old), str(new)]) == 0
    (upgraded,) = Recording(new).values("bundle", check=False)
    assert (upgraded.sensitivity == 1.0).all() and len(upgraded.aligned) == len(upgraded.undone) == len(upgraded.undone_sensitivity) == 0


def test_counts_of_planes_make_room_for_their_offsets(tmp_path):
    """Pose version 10 had an array of another shape in the place of `plane_offsets`."""
    recorded, before, after = (tmp_path / f"{name}.mcap" for name in ("recorded", "before", "after"))
    writer = RecordingWriter(recorded, {})
    writer.write("pose", Pose(0, 0, np.eye(4), np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", "", confirmations=2))
    writer.close()
    rewrite(recorded, before, with_counts_of_planes)
    assert main(["convert", str(before), str(after)]) == 0
    expected, upgraded = (next(Recording(path).values("pose")) for path in (recorded, after))
    assert Encoder().encode(upgraded) == Encoder().encode(expected) and upgraded.confirmations == 2


def with_counts_of_planes(data):
    """A pose of version 10, with two rows of two counts."""
    message = message_class("Pose").FromString(data)
    message.version = 10
    message.plane_offsets.shape[:], message.plane_offsets.data = [2, 2], np.array([[1.0, 2.0], [3.0, 4.0]]).tobytes()
    return message.SerializeToString()


def without(field, version, data):
    """A message of an older version, which lacks a field."""
    message = message_class(LegacyMessage.FromString(data).type).FromString(data)
    message.version = version
    message.ClearField(field)
    return message.SerializeToString()


def write_renamed(source, destination):
    """A recording whose type Map, its table of points and its revision had other names."""
    rewrite(source, destination, renamed)


def renamed(data):
    message = LegacyMessage.FromString(data)
    if message.type != "Map":
        return data
    message.type = "LandmarkMap"
    for array in message.arrays:
        array.name = array.name.replace("points", "corners").replace("revision", "number")
    return message.SerializeToString()


def rewrite(source, destination, change):
    """Write a recording again with each message's content changed."""
    file, writer, numbers = McapFile(source), McapWriter(destination), {}
    writer.metadata("trihedron", file.metadata["trihedron"])
    for number, stamp_ns, data in file.messages():
        channel, schema = file.channels[number], file.schemas[file.channels[number].schema_id]
        if number not in numbers:
            numbers[number] = writer.channel(channel.topic, schema.name, schema.encoding, schema.data, channel.message_encoding)
        data = change(data)
        writer.add(len(data), partial(list, [(numbers[number], stamp_ns, data)]))
    writer.close()
