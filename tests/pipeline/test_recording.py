"""Recordings: what stands first, when chunks close, what a viewer sees, and what a wrong file says."""

import io
import struct
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.reader import make_reader
from mcap.records import Chunk, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core import png_codec
from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.core.geometry import rotation_from_quaternion
from trihedron.pipeline.core.lie import exp_se3, exp_so3
from trihedron.pipeline.core.table import Column, Table
from trihedron.pipeline.core.types import FrameReference, ManhattanFrame, Map, Planes, Pose, Segments, Surface, Trajectory
from trihedron.pipeline.record import mcap_writer as module
from trihedron.pipeline.record.codec import FORMAT, timing_of
from trihedron.pipeline.record.embedded_images import frame_of, messages_of
from trihedron.pipeline.record.foxglove import TopicView
from trihedron.pipeline.record.foxglove_messages import MOST_VERTICES
from trihedron.pipeline.record.reader import Recording, TopicReader
from trihedron.pipeline.record.writer import RecordingWriter

sys.path.insert(0, str(Path(__file__).parent))
from toys import CAMERA, ToyDataset, ToyKeypoints


def keypoints(index):
    return ToyKeypoints()(ToyDataset(40)(index), np.random.default_rng(index))


def write(path, indices, **metadata):
    writer = RecordingWriter(path, {"overrides": '["threads=1"]', **metadata})
    for i in indices:
        writer.write("keypoints", keypoints(i))
        writer.write_timing(i, 1000 * i, 1.5, {"keypoints": 1.25}, 250.0)
    writer.close()
    return path


def test_metadata_stands_before_every_message(tmp_path):
    records = list(StreamReader(io.BytesIO(write(tmp_path / "a.mcap", [1, 2], version="1.2.3").read_bytes())).records)
    kinds = [type(r) for r in records]
    assert kinds.index(Metadata) < kinds.index(next(k for k in kinds if k.__name__ in ("Message", "Chunk", "Schema")))
    assert records[kinds.index(Metadata)].metadata["version"] == "1.2.3"
    assert Recording(tmp_path / "a.mcap").overrides() == ["threads=1"]


def chunks(path):
    with open(path, "rb") as file:
        return [r for r in StreamReader(file, emit_chunks=True).records if isinstance(r, Chunk)]


def test_chunks_close_by_size_and_by_time(tmp_path, monkeypatch):
    assert len(chunks(write(tmp_path / "few.mcap", range(4)))) == 1
    monkeypatch.setattr(module, "CHUNK_BYTES", 5_000)
    many = chunks(write(tmp_path / "size.mcap", [i for _ in range(4) for i in range(38) if i % 5 != 4]))
    assert len(many) > 5 and max(c.uncompressed_size for c in many[1:]) < 10_000  # closed by the message that exceeds it; the first has the schemas
    monkeypatch.setattr(module, "CHUNK_BYTES", 1 << 20)
    monkeypatch.setattr(module, "FLUSH_SECONDS", 0.01)
    ended, end_chunk = threading.Event(), module.McapWriter._end_chunk
    monkeypatch.setattr(module.McapWriter, "_end_chunk", lambda self: (end_chunk(self), ended.set()))
    writer = RecordingWriter(tmp_path / "time.mcap", {})
    for i in (0, 1, 2):
        ended.clear()
        writer.write("keypoints", keypoints(i))
        assert ended.wait(120.0)
    writer.close()
    assert len(chunks(tmp_path / "time.mcap")) == 3


def test_what_cannot_be_encoded_or_shown_is_said_and_what_came_before_is_kept(tmp_path):
    """In the writer's thread, after the call: the next one raises it, or closing."""

    class Broken(TopicView):
        def wants(self, value):
            return True

        def draw_messages(self, value):
            raise ZeroDivisionError(f"frame {value.index}")

    writer = RecordingWriter(tmp_path / "a.mcap", {"overrides": "[]"})
    writer.write("keypoints", keypoints(0))
    writer.show(Broken(), keypoints(1), 1000)
    writer.write("keypoints", keypoints(2))
    with pytest.raises(ZeroDivisionError, match="frame 1"):
        while True:  # until that thread is there
            writer.write("keypoints", keypoints(3))
            time.sleep(0.01)
    with pytest.raises(ZeroDivisionError, match="frame 1"):
        writer.close()
    assert [value.index for value in Recording(tmp_path / "a.mcap").values("keypoints")] == [0]


def test_a_writer_that_is_faster_than_the_disk_waits(tmp_path, monkeypatch):
    """At most MAX_QUEUE_BYTES bytes wait in memory, and all of them arrive."""
    monkeypatch.setattr(module, "CHUNK_BYTES", 10_000)
    monkeypatch.setattr(module, "MAX_QUEUE_BYTES", 50_000)
    writer, most = RecordingWriter(tmp_path / "a.mcap", {"overrides": "[]"}), 0
    for i in range(400):
        writer.write("keypoints", replace(keypoints(0), index=i, stamp_ns=1000 * i))
        most = max(most, writer._file._queued_bytes - writer._file._taken_bytes)
    writer.close()
    assert most <= 50_000 and [value.index for value in Recording(tmp_path / "a.mcap").values("keypoints")] == list(range(400))


def test_one_frame_is_read_alone(tmp_path, monkeypatch):
    """Of a topic that is written as changes, with the messages it builds on; others are found by their stamps."""
    monkeypatch.setattr(module, "CHUNK_BYTES", 3_000)
    writer, empty = RecordingWriter(tmp_path / "a.mcap", {}), Table.empty({"x": Column("f8")})
    points = Table.empty({"x": Column("f8")})
    for i in range(60):
        points, _ = points.appended(x=np.full(10, float(i)))
        writer.write("frames", FrameReference(i, 1000 * i, CAMERA))
        if i % 3:
            writer.write("keypoints", keypoints(i if i % 5 != 4 else i - 1))
        writer.write("map", Map(i, 1000 * i, i, empty, points, empty, empty, empty, empty, empty))
    writer.close()
    recording = Recording(tmp_path / "a.mcap")
    for i in (0, 1, 30, 49, 50, 59):
        frame = recording.frame(i, check=False)  # its map lacks the columns of one
        assert set(frame) == {"frames", "map", *(["keypoints"] if i % 3 and i % 5 != 4 else [])} and all(v.index == i for v in frame.values())
        assert frame["map"].points.column("x").tolist() == np.repeat(np.arange(i + 1.0), 10).tolist()
    assert recording.frame(60) == {}


def test_what_is_asked_for_later_is_written_then(tmp_path):
    """Two frames later, and at the end what is left; a topic's order, and what is read of a frame, stay."""
    writer = RecordingWriter(tmp_path / "a.mcap", {"overrides": "[]"})
    for i in range(8):
        writer.write("frames", FrameReference(i, 1000 * i, CAMERA))
        writer.write("keypoints", keypoints(min(i, 3)), after=2)
    writer.close()
    with open(tmp_path / "a.mcap", "rb") as file:
        found = [channel.topic for _, channel, _ in make_reader(file).iter_messages(log_time_order=False)]
    assert found == ["/frames"] * 2 + ["/keypoints", "/frames"] * 6 + ["/keypoints"] * 2
    assert [value.index for value in Recording(tmp_path / "a.mcap").values("keypoints")] == [0, 1, 2, 3, 3, 3, 3, 3]
    assert set(Recording(tmp_path / "a.mcap").frame(2)) == {"frames", "keypoints"}


def test_a_channel_says_its_ids_units_and_frames(tmp_path):
    """To a reader that knows the format MCAP alone."""
    writer = RecordingWriter(tmp_path / "a.mcap", {"overrides": "[]"})
    writer.write("keypoints", keypoints(0))
    writer.write_timing(0, 0, 1.0, {}, 2.0)
    writer.close()
    with open(tmp_path / "a.mcap", "rb") as file:
        described = {channel.topic: channel.metadata for channel in make_reader(file).get_summary().channels.values()}
    points, timing = described["/keypoints"], described["/timing"]
    assert set(points) == {"type", "meaning", "ids", "units", "frames"} and set(timing) == set(points) - {"meaning"}
    assert points["type"] == "Keypoints" and points["meaning"].startswith("Points of interest. `points_m` is the back-projection")
    assert points["units"].startswith("metres, radians, pixels") and "x right, y down, z forward" in points["frames"]


def test_topics_and_values(tmp_path):
    recording = Recording(write(tmp_path / "a.mcap", [0, 1, 2, 3, 5]))
    assert recording.topics == {"keypoints"} and recording.counts == {"/keypoints": 5, "/timing": 5}
    assert [v.index for v in recording.values("keypoints")] == [0, 1, 2, 3, 5]
    reader = TopicReader(recording, "keypoints")
    assert reader.at(1).index == 1 and reader.latest.index == 0
    assert reader.at(4) is None and reader.latest.index == 3
    assert reader.at(5).index == 5 and reader.at(9) is None

    assert [recording.value("keypoints", 1000 * i).index for i in (5, 0, 2)] == [5, 0, 2] and recording.value("keypoints", 4000) is None
    timing = [timing_of(data) for _, data in recording.messages("/timing")]
    assert timing[1] == {"index": 1, "frame_ms": 1.5, "stage_ms": {"keypoints": 1.25}, "memory_mb": 250.0}


def test_wrong_files_say_so_in_one_line(tmp_path):
    def refusal(path):
        with pytest.raises(RecordingError) as error:
            Recording(path)
        return str(error.value).replace(str(tmp_path), "DIR")

    assert refusal(tmp_path / "no.mcap") == "DIR/no.mcap: cannot be read: No such file or directory; give the path of an MCAP file"
    whole = write(tmp_path / "a.mcap", range(4)).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    assert refusal(tmp_path / "cut.mcap") == (
        "DIR/cut.mcap: is not a complete MCAP file: what wrote it was cut off; rescue what is whole with: trihedron recover DIR/cut.mcap"
    )
    (tmp_path / "text.mcap").write_text("not an MCAP file")
    assert refusal(tmp_path / "text.mcap").startswith("DIR/text.mcap: is not an MCAP file")
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert refusal(tmp_path / "empty.mcap").startswith("DIR/empty.mcap: is not an MCAP file")
    with open(tmp_path / "other.mcap", "wb") as file:
        other = Writer(file)
        other.start()
        other.finish()
    assert refusal(tmp_path / "other.mcap") == (
        "DIR/other.mcap: is an MCAP file, but not a recording of trihedron; convert it with: trihedron convert SRC DST.mcap"
    )
    write(tmp_path / "new.mcap", [0], format="9", version="0.0.9", commit="0123456789")
    assert refusal(tmp_path / "new.mcap") == (
        "DIR/new.mcap: has format 9 of trihedron 0.0.9 0123456, this program reads formats 3 to 6: its arrays and tables are packed otherwise; "
        "upgrade what can be read of it with: trihedron convert SRC DST.mcap"
    )
    with pytest.raises(RecordingError) as error:
        RecordingWriter(tmp_path / "no" / "a.mcap", {})
    assert str(error.value).replace(str(tmp_path), "DIR") == "DIR/no/a.mcap: cannot be written: No such file or directory; give another out=FOLDER"


OLDER = [  # format, commit, what differs
    (
        1,
        "ad955b7",
        "topic /map holds Map version 1, this program reads version 9, with the field 'calibration_errors', 'calibration_information', "
        "'calibration_score', 'loop_closed', 'proposals' that it lacks, and 1 more",
    ),
    (
        2,
        "509b7cf",
        "topic /map holds Map version 3, this program reads version 9, with the field 'calibration_errors', 'calibration_information', "
        "'calibration_score', 'loop_closed', 'proposals' that it lacks, and 2 more",
    ),
]


@pytest.mark.parametrize("form, commit, differs", OLDER)
def test_a_recording_of_an_older_program_names_version_and_field(form, commit, differs, capsys):
    """Three frames that an earlier version of this program wrote; whatever is asked of them."""
    path = Path(__file__).parent / "recordings" / f"format_{form}.mcap"
    line = (
        f"trihedron: {path}: has format {form} of trihedron 0.0.1 {commit}, this program reads formats 3 to 6: {differs} of its topics are others; "
        "upgrade what can be read of it with: trihedron convert SRC DST.mcap\n"
    )
    for words in (["run", f"replay={path}", "only=[pose]"], ["diff", str(path), str(path)], ["export", str(path), "--to", "tum"]):
        assert main(words) == 1
        assert capsys.readouterr().err == line


def test_a_recording_of_format_3_is_upgraded(tmp_path, capsys):
    """Sixty versions of a map, each changed from the one before, whole every fifty, as an earlier version of this program wrote them."""
    path = tmp_path / "new.mcap"
    assert main(["convert", str(Path(__file__).parent / "recordings" / "format_3.mcap"), str(path)]) == 0
    recording = Recording(path)
    for i, value in enumerate(recording.values("map", check=False)):  # it lacks the columns of a map
        expected = np.repeat(np.arange(i + 1.0), 10)
        expected[: i + 1] = -1.0
        if i >= 55:
            expected[256:512] = 0.0
        assert value.points.column("x").tolist() == expected.tolist()
        alone = recording.frame(i, check=False)["map"].points
        assert alone.column("x").tolist() == expected.tolist()
        assert len(alone) < 512 or alone.is_empty(1) == (i >= 55)
    assert i == 59 and recording.metadata["format"] == FORMAT
    assert main(["diff", str(path), str(path)]) == 0
    assert "equal: 60 frames" in capsys.readouterr().out


def test_a_recording_of_format_4_is_read_and_upgraded(tmp_path, capsys):
    """What the previous version wrote, with one schema for all values, times as JSON, is the same after conversion; each type has its schema.
    Poses, tracks and keyframes have fields since, with what nothing is known of."""
    old, new = Path(__file__).parent / "recordings" / "format_4.mcap", tmp_path / "new.mcap"
    assert main(["convert", str(old), str(new)]) == 0
    assert main(["diff", str(old), str(new), "--topics", ",".join(sorted(Recording(old).topics - {"frames", "map", "pose", "tracks"}))]) == 0
    assert "equal: 3 frames" in capsys.readouterr().out
    assert not any(pose.sensitivity.any() or pose.calibration_information.any() for pose in Recording(new).values("pose"))
    assert not any(map.keyframes.column("sensitivity").any() for map in Recording(new).values("map"))
    assert [tracks.repeated for tracks in Recording(new).values("tracks")] == [0.0, 0.0]
    before, after = Recording(old), Recording(new)
    assert after.metadata["format"] == FORMAT and after.topics == before.topics
    images = {"/dataset/color": 3, "/dataset/depth": 3}
    assert {"/dataset": 3, **after.counts} == {**images, **before.counts}
    assert [timing_of(data) for _, data in after.messages("/timing")] == [timing_of(data) for _, data in before.messages("/timing")]
    assert main(["topics", str(old)]) == 0
    listed = capsys.readouterr().out
    assert main(["topics", str(new)]) == 0
    schemas = [[line.split()[:3] for line in text.splitlines()] for text in (listed, capsys.readouterr().out)]
    images = [["/dataset", "trihedron.Frame", "3"], ["/dataset/color", "foxglove.CompressedImage", "3"], ["/dataset/depth", "foxglove.RawImage", "3"]]
    before, after = ([line for line in lines if line not in images] for lines in schemas)
    assert before == after and ["/planes", "trihedron.Planes", "3"] in schemas[1] and ["/timing", "trihedron.Timing", "3"] in schemas[1]


def test_a_large_map_is_shown_more_seldom():
    """12 000 points each other second, 100 each second: what viewers are shown does not grow with the square of the map."""
    columns = {"position_m": Column("f8", (3,)), "alive": Column("?")}
    empty = Table.empty({"x": Column("f8")})
    for count, seconds in ((100, [0, 1, 2, 3, 4]), (12_000, [0, 2, 4])):
        points, _ = Table.empty(columns).appended(position_m=np.zeros((count, 3)), alive=np.ones(count, bool))
        view = TopicView()
        stamps = [k * 500_000_000 for k in range(10)]
        assert [s for s in stamps if view.wants(Map(0, s, 0, empty, points, empty, empty, empty, empty, empty))] == [s * 10**9 for s in seconds]


def loose_mesh(index, vertices, triangles):
    """A surface of triangles in no plane."""
    t = len(triangles)
    labels, texels = np.full(t, -1, np.int32), np.full((t, 3, 2), np.nan, np.float32)
    white = np.full((len(vertices), 3), 255, np.uint8)
    return replace(
        Surface.empty(index, 1000 * index), vertices_m=vertices, colors=white, triangles=triangles, instances=labels, texels=texels
    )  # fmt: skip


def test_a_large_surface_is_shown_coarsely():
    """A sheet of 400 x 400 vertices: at most as many as are allowed are shown, and they still cover it."""
    x, y = np.meshgrid(np.arange(400), np.arange(400))
    vertices = (0.005 * np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)).astype(np.float32)
    corner = (400 * y + x)[:-1, :-1].ravel()
    triangles = np.stack([corner, corner + 1, corner + 401], axis=1).astype(np.int32)
    ((_, message),) = TopicView().messages(loose_mesh(0, vertices, triangles))
    shown = message.entities[0].triangles[0]
    assert 5_000 < len(shown.points) <= MOST_VERTICES and message.ByteSize() < 5_000_000
    corners = np.array([(p.x, p.y) for p in shown.points])[np.array(shown.indices).reshape(-1, 3)]
    assert np.ptp(corners.reshape(-1, 2), axis=0) == pytest.approx(1.995, abs=0.1)


def test_errors_the_path_and_the_log_of_poses():
    """The truth is another world's; the second pose is 0.1 m and 2 degrees off, the third lost."""
    T_truth_world = exp_se3(np.array([1.0, -2.0, 0.5, 0.3, 0.2, -0.9]))
    true = [exp_se3(np.array([0.1 * i, 0, 0, 0, 0.05 * i, 0])) for i in range(3)]
    off = exp_se3(np.array([0, 0.1, 0, 0, 0, np.radians(2.0)]))
    said = [true[0], true[1] @ off, true[2]]
    stamps = 50_000_000 * np.arange(3)
    view = TopicView(Trajectory(stamps + 1_000_000, np.array([T_truth_world @ T for T in true])))
    found = []
    for i, (T, status) in enumerate(zip(said, ("ok", "degraded", "lost"))):
        pose = Pose(i, int(stamps[i]), T, np.eye(6), T, -1, np.zeros(3, np.int32), 0, status, "why" if i else "")
        found.append(dict(view.messages(pose)))
    assert [set(messages) - {"/view/pose", "/tf"} for messages in found] == [
        {"/view/path", "/view/truth", "/error"}, {"/view/truth", "/error", "/view/log"}, {"/view/log"}
    ]  # fmt: skip
    assert found[0]["/error"].translation_m < 1e-9 and found[0]["/error"].rotation_deg < 1e-5
    assert found[1]["/error"].translation_m == pytest.approx(np.linalg.norm(off[:3, 3])) and found[1]["/error"].rotation_deg == pytest.approx(2.0)
    position = found[1]["/view/truth"].pose.position
    assert (position.x, position.y, position.z) == pytest.approx(true[1][:3, 3])
    assert found[2]["/view/log"].message == "frame 2: lost, why"


@pytest.mark.parametrize("R", [exp_so3(np.array([0.3, -0.2, 0.5])), np.diag([-1.0, -1.0, 1.0])])
def test_axes_are_arrows_along_them(R):
    axes = ManhattanFrame(0, 0, R[None], np.zeros(1, np.int32), np.zeros((1, 3, 3)), np.ones((1, 3), np.int32), np.zeros((1, 3)), True)
    ((channel, message),) = TopicView().messages(axes)
    assert channel == "/view/axes"
    for axis, arrow in zip(R.T, message.entities[0].arrows):
        q = arrow.pose.orientation
        assert rotation_from_quaternion(np.array([q.x, q.y, q.z, q.w]))[:, 0] == pytest.approx(axis)


def test_viewer_messages_are_decoded_by_their_own_schema(tmp_path):
    view, frame = TopicView(), ToyDataset()(3)
    pixels, points, covariance = (np.zeros((2, 2, *shape), np.float32) for shape in ((2,), (3,), (3, 3)))
    lines = Segments(3, 3000, pixels, points, covariance, np.zeros((2, 0), np.uint8))
    square = np.array([[[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2], [0, 0, 2]]], np.float32)
    labels = np.zeros((2, 2), np.uint8)
    front = np.array([[0, 0, -1.0, 2.0]])
    plane = Planes(3, 3000, front, np.zeros((1, 3, 3)), np.zeros((1, 4, 4)), np.ones(1, np.int32), square, labels, 2)
    writer = RecordingWriter(tmp_path / "a.mcap", {})
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0]], np.float32)
    mesh = loose_mesh(3, corners, np.array([[0, 1, 2]], np.int32))
    for value in (frame, lines, plane, mesh, Surface.empty(3, 3000)):
        writer.show(view, value, value.stamp_ns)
    writer.close()
    assert list(view.messages(frame)) == []  # the same fifth of a second
    with open(tmp_path / "a.mcap", "rb") as file:
        found = {c.topic: (s.name, m) for s, c, _, m in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()}
    assert {topic: name for topic, (name, _) in found.items()} == {
        "/view/image": "foxglove.CompressedImage",
        "/view/camera": "foxglove.CameraCalibration",
        "/view/features": "foxglove.ImageAnnotations",
        "/view/lines": "foxglove.SceneUpdate",
        "/view/planes": "foxglove.SceneUpdate",
        "/view/surface": "foxglove.SceneUpdate",
    }
    entity = found["/view/surface"][1].entities[0]
    assert entity.frame_id == "world" and list(entity.triangles[0].indices) == [0, 1, 2] and len(entity.triangles[0].colors) == 3
    assert list(found["/view/camera"][1].K) == [2.0, 0, 1.5, 0, 2.0, 1.0, 0, 0, 1]
    assert len(found["/view/lines"][1].entities[0].lines[0].points) == 4
    assert len(found["/view/planes"][1].entities[0].triangles[0].points) == 6  # the square, without the point inside
    assert found["/view/image"][1].format == "jpeg" and found["/view/image"][1].data[:2] == b"\xff\xd8"


def test_images_of_format_5_are_read_and_become_those_of_foxglove(tmp_path, capsys):
    """Embedded images were values; they are the same after conversion, and as PNG and readings that other tools show."""
    old, new = Path(__file__).parent / "recordings" / "format_5.mcap", tmp_path / "new.mcap"
    assert main(["convert", str(old), str(new)]) == 0
    assert main(["diff", str(old), str(new)]) == 0
    assert "equal: 3 frames (0..2) of dataset, planes" in capsys.readouterr().out
    before, after = Recording(old), Recording(new)
    assert after.topics == before.topics and "/dataset" not in after.channels
    frames = [list(recording.values("dataset")) for recording in (before, after)]
    room = Synthetic(length=3, width=64, height=48)
    for index, (ours, theirs) in enumerate(zip(*frames)):
        assert (ours.index, ours.stamp_ns, ours.camera) == (theirs.index, theirs.stamp_ns, theirs.camera)
        for frame in (ours, theirs, after.frame(index)["dataset"]):
            np.testing.assert_array_equal(frame.color, room(index).color, strict=True)
            np.testing.assert_array_equal(frame.depth_m, room(index).depth_m, strict=True)
    (_, data), *_ = after.messages("/dataset/color")
    read = cv2.imdecode(np.frombuffer(CompressedImage.FromString(data).data, np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(read[..., ::-1], room(0).color)


@pytest.mark.parametrize(
    ("part", "old", "new", "message"),
    [
        (0, b"IDAT", b"IDAX", "frame 0: an image cannot be read: "),
        (0, struct.pack(">II", 32, 16), b"\x7f" * 8, "frame 0: an image cannot be read: it is no PNG of three channels and eight bits"),
        (1, b"32FC1", b"16UC1", "frame 0: an image cannot be read: its encoding is '16UC1', not 32FC1"),
        (1, b"\x1d\x10", b"\x1d\x11", "frame 0: an image cannot be read: "),
    ],
)
@pytest.mark.parametrize("has_imagecodecs", [True, False], ids=["imagecodecs", "opencv"])
def test_damaged_images_are_one_line(part, old, new, message, has_imagecodecs, monkeypatch):
    monkeypatch.setattr(png_codec, "HAS_IMAGECODECS", has_imagecodecs)
    frame = Synthetic(length=1, width=32, height=16)(0)
    parts = [one.SerializeToString() for _, one in messages_of(frame)]
    reference = FrameReference(0, 0, frame.camera)
    assert (frame_of(reference, *parts, "FILE").color == frame.color).all()
    assert old in parts[part]
    parts[part] = parts[part].replace(old, new, 1)
    with pytest.raises(RecordingError) as error:
        frame_of(reference, *parts, "FILE")
    assert str(error.value).startswith(f"FILE: {message}") and str(error.value).endswith("; the file is damaged; record it again")
