"""Two recordings are compared value by value."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.table import Column, Table
from trihedron.pipeline.core.types import FrameReference, Map, Pose
from trihedron.pipeline.record.writer import RecordingWriter

sys.path.insert(0, str(Path(__file__).parents[1] / "pipeline"))
from toys import CAMERA


def pose(index, **changes):
    found = Pose(index, 1000 * index, np.eye(4), np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", "")
    return replace(found, **changes)


def version(index, rows):
    empty = Table.empty({"x": Column("f8")})
    points = empty.appended(x=np.array(rows, float))[0]
    return Map(index, 1000 * index, index, empty, points, empty, empty, empty, empty, empty)


def record(path, indices, poses=None, maps=None, topics=("pose", "map")):
    writer = RecordingWriter(path, {})
    for i in indices:
        writer.write("frames", FrameReference(i, 1000 * i, CAMERA))
        if "pose" in topics:
            writer.write("pose", (poses or {}).get(i, pose(i)))
        if "map" in topics and i % 2 == 0:
            writer.write("map", (maps or {}).get(i, version(i, np.arange(i + 1))))
    writer.close()
    return str(path)


def diff(capsys, *words):
    code = main(["diff", *words])
    said = capsys.readouterr()
    return code, (said.out + said.err).splitlines()


def test_equal_recordings_of_different_ranges_and_topics(tmp_path, capsys):
    a, b = record(tmp_path / "a.mcap", range(10)), record(tmp_path / "b.mcap", range(4, 15))
    assert diff(capsys, a, a) == (0, ["equal: 10 frames (0..9) of pose, map"])
    lacking = [f"{a} lacks 5 frames of the other (10..14)", f"{b} lacks 4 frames of the other (0..3)"]
    assert diff(capsys, a, b) == (0, [*lacking, "equal: 6 frames (4..9) of pose, map"])
    assert diff(capsys, a, "--topics", "pose", b) == (0, [*lacking, "equal: 6 frames (4..9) of pose"])
    c = record(tmp_path / "c.mcap", range(3), topics=("pose",))
    lacking = [f"{c} has no map", f"{c} lacks 7 frames of the other (3..9)"]
    assert diff(capsys, c, a) == (0, [*lacking, "equal: 3 frames (0..2) of pose"])
    assert diff(capsys, c, a, "--tolerance", "0") == (0, [*lacking, "equal within 0: 3 frames (0..2) of pose"])


def test_topics_that_were_not_asked_for_are_not_spoken_of(tmp_path, capsys):
    a, c = record(tmp_path / "a.mcap", range(3)), record(tmp_path / "c.mcap", range(3), topics=("pose",))
    assert diff(capsys, a, c, "--topics", "pose") == (0, ["equal: 3 frames (0..2) of pose"])
    assert diff(capsys, a, c, "--topics", "pose", "--tolerance", "0") == (0, ["equal within 0: 3 frames (0..2) of pose"])


def test_the_first_difference_is_named_with_its_size(tmp_path, capsys):
    moved = np.eye(4)
    moved[0, 3] = 0.25
    poses = {5: pose(5, T_world_camera=moved), 7: pose(7, status="lost")}
    a = record(tmp_path / "a.mcap", range(10))
    b = record(tmp_path / "b.mcap", range(10), poses, {4: version(4, [0, 1, 2, 3, 4.5]), 6: version(6, np.arange(7) * 2)})
    code, lines = diff(capsys, a, b)
    assert code == 1 and lines[0] == "map, frame 4, points.x: up to 0.5 in 1 of 5, first at [4]"
    assert lines[2].split() == ["pose", "5", "T_world_camera", "up", "to", "0.25", "in", "1", "of", "16,", "first", "at", "[0,", "3]", "2"]
    assert lines[3].split() == ["map", "4", "points.x", "up", "to", "0.5", "in", "1", "of", "5,", "first", "at", "[4]", "2"]
    code, lines = diff(capsys, a, b, "--topics", "pose")
    assert code == 1 and lines[0] == "pose, frame 5, T_world_camera: up to 0.25 in 1 of 16, first at [0, 3]" and len(lines) == 3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"status": "lost"}, "pose, frame 3, status: 'ok' and 'lost'"),
        ({"reference": 4}, "pose, frame 3, reference: up to 5 in 1 of 1"),
        ({"inliers": np.array([0, 2, 0], np.int32)}, "pose, frame 3, inliers: up to 2 in 1 of 3, first at [1]"),
        ({"covariance": np.eye(6) + np.diag([0, 0, 1e-12, 0, 0, 0])}, "pose, frame 3, covariance: up to 1e-12 in 1 of 36, first at [2, 2]"),
    ],
)
def test_fields(tmp_path, capsys, change, said):
    a, b = record(tmp_path / "a.mcap", range(5)), record(tmp_path / "b.mcap", range(5), {3: pose(3, **change)})
    code, lines = diff(capsys, a, b)
    assert code == 1 and lines[0] == said


def test_a_value_that_one_lacks_and_nothing_in_common(tmp_path, capsys):
    a, b = record(tmp_path / "a.mcap", range(5)), record(tmp_path / "b.mcap", range(5), topics=("map",))
    assert diff(capsys, a, b)[0] == 0
    code, lines = diff(capsys, a, b, "--topics", "pose")
    assert code == 1 and lines == ["trihedron: --topics pose: is not a topic of both recordings; known: map"]
    c = record(tmp_path / "c.mcap", range(7, 9))
    assert diff(capsys, a, c)[1] == [f"trihedron: {a}, {c}: have no frame in common; compare two runs over the same frames"]
    writer = RecordingWriter(tmp_path / "d.mcap", {})
    for i in range(5):
        writer.write("frames", FrameReference(i, 1000 * i, CAMERA))
        if i != 2:
            writer.write("pose", pose(i))
    writer.close()
    assert diff(capsys, a, str(tmp_path / "d.mcap"))[1][1] == "pose, frame 2, value: only in the first"


def test_a_tolerance_lists_every_field_that_differs(tmp_path, capsys):
    far = np.eye(4)
    far[0, 3] = 1000.0
    near = {2: pose(2, T_world_camera=far + 1e-4 * (far == 1000.0), covariance=np.eye(6) * (1 + 1e-9))}
    a, b = record(tmp_path / "a.mcap", range(5), {2: pose(2, T_world_camera=far)}), record(tmp_path / "b.mcap", range(5), near)
    assert diff(capsys, a, a, "--tolerance", "0") == (0, ["equal within 0: 5 frames (0..4) of pose, map"])
    code, lines = diff(capsys, a, b, "--tolerance", "1e-6")
    assert code == 0 and lines[-1] == "equal within 1e-06: 5 frames (0..4) of pose, map"
    assert lines[-3].split() == ["pose", "T_world_camera", "1e-07", "2", "equal", "within", "1e-06"]
    assert lines[-2].split() == ["pose", "covariance", "1e-09", "2", "equal", "within", "1e-06"]
    code, lines = diff(capsys, a, b, "--tolerance", "1e-8")
    assert code == 1 and lines[-1] == "different within 1e-08: 5 frames (0..4) of pose, map" and "different" in lines[-3]
    c = record(tmp_path / "c.mcap", range(5), {2: pose(2, T_world_camera=far, reference=0, status="lost")})
    code, lines = diff(capsys, a, c, "--tolerance", "0.9")  # ids are equal or not
    assert code == 1 and [line.split()[1:3] for line in lines[-3:-1]] == [["reference", "1"], ["status", "not"]]
    assert diff(capsys, a, b, "--tolerance", "-1") == (2, ["trihedron: --tolerance: -1 is not a tolerance; give a number from 0"])
