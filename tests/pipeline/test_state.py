"""Saved maps: a run cut in two gives what one run gives, another day only the map is used, and no file is trusted."""

import errno
import json
import os
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.record import mcap_writer
from trihedron.pipeline.record.codec import Encoder
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.map_file import SavedMap, load_map, save_map
from trihedron.pipeline.run.runner import Runner
from trihedron.pipeline.run.state import DelayLines, StateBuffer, max_delays
from trihedron.plugins.mapping.landmarks import empty_map

sys.path.insert(0, str(Path(__file__).parent))
from toys import ToyDataset, run_in, toy_graph

SMALL = ["dataset.width=320", "dataset.height=240"]
JOBS = {
    "whole": ["dataset.frames=0:14"],
    "first": ["dataset.frames=0:8", "save_map=map.mcap"],
    "rest": ["dataset.frames=8:14", "load_map=map.mcap", "threads=1"],
    "elsewhere": ["dataset.frames=10:12", "load_map=map.mcap", "save_map=again.mcap", "dataset.length=900"],
    "nowhere": ["dataset.scene=corridor", "dataset.frames=0:5", "load_map=map.mcap", "localise_only=true", "pose.submap_after=2"],
    "only": ["dataset.frames=10:12", "load_map=map.mcap", "localise_only=true", "save_map=only.mcap"],
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    jobs = [[*SMALL, *words, f"out={name}"] for name, words in JOBS.items()]
    jobs.append(["replay=elsewhere/run.mcap", "only=[pose]", "out=replayed"])
    run_in(folder, *jobs)
    return folder


def contents(path, topic, first):
    """Frame -> bytes of the value written whole, from frame `first` on."""
    return {v.index: Encoder().encode(v) for v in Recording(path).values(topic) if v.index >= first}


def test_a_run_cut_in_two_gives_what_one_run_gives(runs):
    """Every topic, bit for bit."""
    whole, rest = Recording(runs / "whole" / "run.mcap"), Recording(runs / "rest" / "run.mcap")
    assert whole.topics == rest.topics >= {"pose", "map", "tracks", "matches", "rotation"}
    for topic in whole.topics:
        assert contents(whole.path, topic, 8) == contents(rest.path, topic, 8), topic
    lines = (runs / "whole" / "trajectory.txt").read_text().splitlines()
    assert (runs / "rest" / "trajectory.txt").read_text().splitlines()[-6:] == lines[-6:]


def test_in_another_sequence_the_camera_is_lost_until_the_map_is_recognised(runs):
    """Another frame than the next, or other options of the data set: the first frame is recognised, in the world of the map."""
    true = {pose.index: pose.T_world_camera for pose in Recording(runs / "whole" / "run.mcap").values("pose")}
    for name in ("elsewhere", "only"):
        (first, *_) = Recording(runs / name / "run.mcap").values("relocalise")
        assert first.index == 10 and first.reason.startswith("recognised by ")
        poses = list(Recording(runs / name / "run.mcap").values("pose"))
        assert [pose.status for pose in poses] == ["ok"] * 2
        assert all(np.linalg.norm(pose.T_world_camera[:3, 3] - true[pose.index][:3, 3]) < 0.02 for pose in poses)


def test_localising_leaves_the_map_alone(runs):
    assert "map" not in Recording(runs / "only" / "run.mcap").topics
    before, after = load_map(str(runs / "map.mcap")), load_map(str(runs / "only.mcap"))
    assert Encoder().encode(before.map) == Encoder().encode(after.map)
    assert load_map(str(runs / "again.mcap")).frame == 11


def test_a_camera_that_is_only_localised_stays_lost_where_the_map_does_not_reach(runs):
    """It begins no sub-map, after however many frames: nobody would keep it."""
    poses = list(Recording(runs / "nowhere" / "run.mcap").values("pose"))
    assert len(poses) == 5 and {(pose.status, pose.submap) for pose in poses} == {("lost", 0)}
    metrics = json.loads((runs / "nowhere" / "metrics.json").read_text())
    assert metrics["unmerged"] == 0 and metrics["status"]["lost"] == 5
    assert (runs / "nowhere" / "trajectory.txt").read_text().count("\n") <= 1


def test_a_replay_loads_the_map_again_and_saves_none(runs):
    assert contents(runs / "replayed" / "run.mcap", "pose", 0) == contents(runs / "elsewhere" / "run.mcap", "pose", 0)
    assert (runs / "again.mcap").stat().st_mtime < (runs / "only.mcap").stat().st_mtime


@pytest.mark.parametrize("cut, rotations", [(7, [5, 6]), (8, [5, 6, 7])])  # rotation says nothing at frame 4
@pytest.mark.parametrize("stride", [1, 6])
def test_a_run_continues_with_the_values_of_wires_of_any_delay(cut, rotations, stride):
    """Some of twelve frames, and the rest: what `@prev` and `@k` see is what they see in twelve frames at once."""

    def run(count, start, initial=None):
        dataset = ToyDataset(length=count, start=start * stride, stride=stride)
        runner = Runner(toy_graph(outputs=("trajectory",), dataset=dataset), frames=f"{start * stride}::{stride}", initial=initial)
        runner.state = StateBuffer({"rotation": 3, "pose": 1}, runner.initial, start * stride)
        for _ in runner.steps(None, frozenset()):
            pass
        return runner

    whole, first = run(12, 0), run(cut, 0)
    kept = first.state.values
    assert list(kept["rotation"]) == rotations and list(kept["pose"]) == [cut - 1]
    saved = SavedMap(first.state.frame, "", {topic: tuple(values.values()) for topic, values in kept.items()} | {"map": (first.result.map,)})
    lines = saved.delay_lines(cut * stride, stride, "")
    assert list(lines.recent["rotation"]) == [number - cut for number in rotations]
    rest = run(12 - cut, cut, lambda _: lines)
    assert [p.T_world_camera[0, 3] for p in rest.result.poses] == [p.T_world_camera[0, 3] for p in whole.result.poses if p.index >= cut * stride]


def test_the_maximum_delay_of_a_topic():
    stages = toy_graph().stages
    assert max_delays(stages.values()) == {"rotation": 1, "pose": 1, "map": 1}


def test_a_map_that_cannot_be_written_is_one_line_and_leaves_nothing(runs, tmp_path, monkeypatch):
    state = StateBuffer({"map": 1}, DelayLines(), 0)
    state.append(3, {"map": load_map(str(runs / "map.mcap")).map})
    with pytest.raises(RecordingError) as error:
        save_map(tmp_path / "no" / "a.mcap", state, {}, "{}")
    assert str(error.value) == f"{tmp_path}/no/a.mcap: cannot be written: No such file or directory; give another save_map=FILE.mcap"
    monkeypatch.setattr(mcap_writer.os, "write", full_disk)
    with pytest.raises(RecordingError) as error:
        save_map(tmp_path / "a.mcap", state, {}, "{}")
    assert str(error.value) == f"{tmp_path}/a.mcap: cannot be written: No space left on device; give another save_map=FILE.mcap"
    assert list(tmp_path.iterdir()) == []


def full_disk(descriptor, data):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def written(path, metadata, map=None):
    writer = RecordingWriter(path, {"kind": "map", "map_version": "1", "frame": "3", "source": "{}", **metadata})
    writer.write("map", map if map is not None else empty_map(3, 3, 32, 32, 8))
    writer.close()
    return str(path)


def test_a_file_that_is_no_map_of_this_version_is_refused(tmp_path):
    path = str(tmp_path / "a.mcap")
    for metadata, cause in (
        ({"map_version": "2"}, "is a map of version 2, this program reads version 1; make the map anew"),
        ({"kind": "run"}, "is a recording, not a saved map; save one with: trihedron run save_map=FILE.mcap"),
        ({"frame": "many"}, "holds a map that does not fit together: "),
    ):
        with pytest.raises(RecordingError) as error:
            load_map(written(tmp_path / "a.mcap", metadata))
        assert str(error.value).startswith(f"{path}: {cause}")
    assert load_map(written(tmp_path / "a.mcap", {})).map.revision == 0
    with pytest.raises(RecordingError, match="there is no such map; save one with"):
        load_map(str(tmp_path / "missing.mcap"))


def test_a_map_whose_rows_name_others_that_are_not_there_is_refused(runs, tmp_path):
    map = load_map(str(runs / "map.mcap")).map
    row = np.zeros(1, np.int32)
    points, keyframes = len(map.points), len(map.keyframes)
    broken = [
        (replace(map, points=map.points.updated(row, observers=np.full((1, 16), 1 << 20, np.int32))), "points",
         f"a column 'observers' that names row {1 << 20} of keyframes, which has {keyframes} rows"),
        (replace(map, point_observations=map.point_observations.updated(row, point=row - 1)), "point_observations",
         f"a column 'point' that names row -1 of points, which has {points} rows"),
        (replace(map, keyframes=map.keyframes.updated(row, lines=np.array([[0, 1 << 20]], np.int32))), "keyframes",
         f"a column 'lines' that names row {1 << 20} of line_observations, which has {len(map.line_observations) + 1} rows"),
        (replace(map, keyframes=map.keyframes.updated(row, T_world_camera=np.full((1, 4, 4), np.nan))), "keyframes",
         "a column 'T_world_camera' that is not a rotation with a translation"),
        (replace(map, line_observations=map.points), "line_observations", "no column 'keyframe' of int32[]"),
    ]  # fmt: skip
    for damaged, field, cause in broken:
        with pytest.raises(RecordingError) as error:
            load_map(written(tmp_path / "b.mcap", {}, damaged))
        place = f"{tmp_path}/b.mcap: topic /map, frame {map.index}"
        assert str(error.value) == f"{place}: the field '{field}' has {cause}; the file is damaged; record it again"


@pytest.mark.parametrize("at", [0.2, 0.5, 0.9])
def test_a_damaged_file_is_one_line(runs, tmp_path, at):
    """Cut off, or with a byte changed anywhere before its summary: an error that names the file."""
    data = (runs / "map.mcap").read_bytes()
    place = int(at * struct.unpack_from("<Q", data, len(data) - 28)[0])  # of the summary, by the footer
    for name, damaged in (("cut", data[:place]), ("changed", data[:place] + bytes([data[place] ^ 0x5A]) + data[place + 1 :])):
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(damaged)
        with pytest.raises(RecordingError) as error:
            load_map(str(path))
        assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)
