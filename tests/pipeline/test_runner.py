"""The runner and its recordings: equal bytes for any thread count, and for any stage run again alone."""

import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.errors import DataError, RecordingError, StageError
from trihedron.pipeline.record.codec import Encoder
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run import warm_up
from trihedron.pipeline.run.replay import Replay
from trihedron.pipeline.run.runner import Runner
from trihedron.pipeline.run.state import StateBuffer

sys.path.insert(0, str(Path(__file__).parent))
from toys import CAMERA, TOPICS, ToyDataset, ToyRotation, contents, toy_graph


def record(path, graph=None, threads=2, replay=None, topics=TOPICS, frames="", **options):
    """Run into a file; the runner afterwards."""
    writer = RecordingWriter(path, {"overrides": "[]"})
    runner = Runner(graph or toy_graph(), seed=3, threads=threads, replay=replay, frames=frames)
    try:
        for _ in runner.steps(writer, topics, **options):
            pass
    finally:
        writer.close()
    return runner


def test_stages_are_warmed_up_once_a_process_and_with_other_options_again(monkeypatch):
    monkeypatch.setattr(warm_up, "_WARM", set())
    read, call, counts = [], ToyDataset.__call__, []

    def counted(self, index):
        read.append(index)
        return call(self, index)

    monkeypatch.setattr(ToyDataset, "__call__", counted)
    for graph in (toy_graph(), toy_graph(dataset=ToyDataset(length=9)), toy_graph(rotation=ToyRotation(gain=3.0))):
        warm_up.warm_up(Runner(graph))
        counts.append(len(read))
    assert counts == [3, 3, 6]


def without(source, topic, path):
    """A copy of a recording that lacks one topic."""
    recording = Recording(source)
    writer = RecordingWriter(path, {k: v for k, v in recording.metadata.items() if k != "format"})
    for name in recording.topics - {topic}:
        for value in recording.values(name):
            writer.write(name, value)
    writer.close()
    return path


def test_bytes_do_not_depend_on_threads(tmp_path):
    for threads in (1, 2, 4):
        record(tmp_path / f"{threads}.mcap", threads=threads)
    one = contents(tmp_path / "1.mcap")
    assert set(one) >= {"/frames", "/keypoints", "/rotation", "/pose", "/map", "/surface", "/view/image", "/view/pose", "/tf"}
    assert contents(tmp_path / "2.mcap") == one == contents(tmp_path / "4.mcap")


def test_seed_and_frame_make_the_generator(tmp_path):
    record(tmp_path / "a.mcap")
    values = list(Recording(tmp_path / "a.mcap").values("keypoints"))
    expected = np.random.default_rng([3, 7, zlib.crc32(b"keypoints")]).random((7, 2), dtype=np.float32)
    assert np.array_equal(next(v for v in values if v.index == 7).pixels, expected)


@pytest.mark.parametrize("stage", ["keypoints", "rotation", "pose", "map", "surface"])
@pytest.mark.parametrize("feedback", [False, True])
def test_a_stage_run_again_gives_its_bytes(tmp_path, stage, feedback):
    record(tmp_path / "a.mcap")
    replay = Replay(Recording(without(tmp_path / "a.mcap", stage, tmp_path / "b.mcap")), (stage,), feedback)
    runner = record(tmp_path / "c.mcap", replay=replay, topics=frozenset({stage}))
    again = contents(tmp_path / "c.mcap")
    assert again[f"/{stage}"] == contents(tmp_path / "a.mcap")[f"/{stage}"]
    assert {name for name in again if "/" not in name[1:]} <= {f"/{stage}", "/frames", "/tf"}
    assert stage in runner.computed


def test_replay_computes_what_was_not_recorded(tmp_path):
    record(tmp_path / "a.mcap")
    runner = record(tmp_path / "b.mcap", replay=Replay(Recording(tmp_path / "a.mcap"), ("normals",)), topics=frozenset({"normals"}))
    assert runner.computed == ("dataset", "normals")
    runner = record(tmp_path / "c.mcap", replay=Replay(Recording(tmp_path / "a.mcap"), ("rotation",)), topics=frozenset({"rotation"}))
    assert runner.computed == ("rotation",)


def test_replay_with_another_option_changes_the_topic_and_own_past_is_new_or_recorded(tmp_path):
    record(tmp_path / "a.mcap")
    totals = {}
    for name, feedback in (("new", False), ("recorded", True)):
        replay = Replay(Recording(tmp_path / "a.mcap"), ("rotation",), feedback)
        record(tmp_path / f"{name}.mcap", toy_graph(rotation=ToyRotation(gain=2.0)), replay=replay, topics=frozenset({"rotation"}))
        totals[name] = {v.index: v.covariance[0, 0] for v in Recording(tmp_path / f"{name}.mcap").values("rotation")}
    counts = [i for i in range(12) if i % 5 != 4]
    assert totals["new"][3] == 2 * (0 + 1 + 2 + 3)
    assert totals["recorded"][3] == 2 * 3 + (0 + 1 + 2)
    assert sorted(totals["new"]) == counts


def test_replay_of_a_range_begins_with_the_recorded_past(tmp_path):
    record(tmp_path / "a.mcap")
    replay = Replay(Recording(tmp_path / "a.mcap"), ("rotation", "pose"))
    graph = toy_graph(dataset=ToyDataset(length=3, start=6))
    runner = record(tmp_path / "b.mcap", graph, replay=replay, topics=frozenset({"rotation", "pose"}), frames="6:9")
    whole = {v.index: v for v in Recording(tmp_path / "a.mcap").values("pose")}
    part = {v.index: v for v in Recording(tmp_path / "b.mcap").values("pose")}
    assert runner.indices == [6, 7, 8] and sorted(part) == [6, 7, 8]
    assert all(np.array_equal(part[i].T_world_camera, whole[i].T_world_camera) for i in part)


STRIDED = ToyDataset(length=9, start=2, stride=4)  # frames 2, 6, … 34


def test_a_run_of_every_fourth_frame_has_their_numbers_and_a_quarter_of_the_rate(tmp_path):
    runner = record(tmp_path / "a.mcap", toy_graph(dataset=STRIDED), frames="2:36:4")
    references = list(Recording(tmp_path / "a.mcap").references)
    assert list(runner.indices) == [value.index for value in references] == list(range(2, 36, 4))
    assert {value.camera.fps for value in references} == {CAMERA.fps / 4} == {runner.result.fps}


@pytest.mark.parametrize("only", [("dataset", "keypoints", "rotation", "pose", "map"), ("rotation",), ("keypoints", "pose")])
@pytest.mark.parametrize("feedback", [False, True])
def test_a_replay_of_every_fourth_frame_gives_its_bytes(tmp_path, only, feedback):
    record(tmp_path / "a.mcap", toy_graph(dataset=STRIDED), frames="2:36:4")
    replay = Replay(Recording(tmp_path / "a.mcap"), only, feedback)
    record(tmp_path / "b.mcap", toy_graph(dataset=STRIDED), replay=replay, topics=frozenset(only) - {"dataset"}, frames="2:36:4")
    whole, again = contents(tmp_path / "a.mcap"), contents(tmp_path / "b.mcap")
    assert all(again[name] == whole[name] for name in ("/frames", *(f"/{stage}" for stage in only if stage != "dataset")))


def test_a_replay_of_consecutive_numbers_takes_the_recorded_ones_among_them(tmp_path):
    """The frames are read from the data set by their numbers, and have the rate they were recorded with."""
    record(tmp_path / "a.mcap", toy_graph(dataset=STRIDED), frames="2:36:4")
    replay = Replay(Recording(tmp_path / "a.mcap"), ("dataset", "keypoints", "rotation", "pose"))
    part = toy_graph(dataset=ToyDataset(length=16, start=8))
    topics = frozenset({"keypoints", "rotation", "pose"})
    runner = record(tmp_path / "b.mcap", part, replay=replay, topics=topics, frames="8:24")
    assert runner.indices == [10, 14, 18, 22] and {value.camera.fps for value in Recording(tmp_path / "b.mcap").references} == {CAMERA.fps / 4}
    for topic in topics:
        whole = {value.index: Encoder().encode(value) for value in Recording(tmp_path / "a.mcap").values(topic)}
        assert all(whole[value.index] == Encoder().encode(value) for value in Recording(tmp_path / "b.mcap").values(topic))


def test_a_stride_does_not_change_what_delayed_wires_read(tmp_path):
    """Nine consecutive frames and every sixth of 54: each has the values of as many frames before, by position."""
    kept = []
    for dataset, frames in ((ToyDataset(length=9), "0:9"), (ToyDataset(length=9, stride=6), "0:54:6")):
        runner = Runner(toy_graph(dataset=dataset), frames=frames)
        runner.state = StateBuffer({"rotation": 3, "pose": 1}, runner.initial, 0)
        for _ in runner.steps(None, frozenset()):
            pass
        kept.append({topic: list(values) for topic, values in runner.state.values.items()})
    assert kept[0] == kept[1] == {"rotation": [6, 7, 8], "pose": [8]}


def test_replay_of_no_frame_says_so(tmp_path):
    record(tmp_path / "a.mcap")
    with pytest.raises(RecordingError) as error:
        Runner(toy_graph(), replay=Replay(Recording(tmp_path / "a.mcap"), ("pose",)), frames="20:30")
    assert str(error.value) == f"{tmp_path}/a.mcap: has none of the frames '20:30'; give another dataset.frames"


def test_a_replay_that_needs_images_says_when_they_are_gone(tmp_path):
    class Gone(ToyDataset):
        def __len__(self):
            raise DataError("rooms/a", "does not exist", "give an existing folder")

    record(tmp_path / "a.mcap")
    with pytest.raises(RecordingError) as error:
        Runner(toy_graph(dataset=Gone()), replay=Replay(Recording(tmp_path / "a.mcap"), ("keypoints",)))
    assert str(error.value) == (
        f"{tmp_path}/a.mcap: does not embed the frames that keypoints must see, and the data set is gone (rooms/a: does not exist); "
        "give its new place as dataset.path=FOLDER"
    )
    assert Runner(toy_graph(dataset=Gone()), replay=Replay(Recording(tmp_path / "a.mcap"), ("rotation",))).computed == ("rotation",)


def test_embedded_frames_replace_the_folder(tmp_path):
    record(tmp_path / "a.mcap", topics=TOPICS | {"dataset"}, embed_frames=True)
    replay = Replay(Recording(tmp_path / "a.mcap"), ("keypoints", "normals"))
    runner = record(tmp_path / "b.mcap", toy_graph(dataset=ToyDataset(length=0)), replay=replay, topics=frozenset({"keypoints"}))
    assert runner.computed == ("normals", "keypoints")
    assert contents(tmp_path / "b.mcap")["/keypoints"] == contents(tmp_path / "a.mcap")["/keypoints"]


def test_a_failing_stage_names_itself_and_keeps_the_rest(tmp_path):
    with pytest.raises(StageError) as error:
        record(tmp_path / "a.mcap", toy_graph(rotation=ToyRotation(fails_at=6)))
    assert str(error.value) == (
        "rotation (ToyRotation), frame 6: ValueError: matrix is singular; "
        f"repeat only that with: trihedron run replay={tmp_path}/a.mcap 'only=[rotation]' dataset.frames=6:7"
    )
    recording = Recording(tmp_path / "a.mcap")
    assert [v.index for v in recording.values("pose")] == [0, 1, 2, 3, 5]
    assert [v.index for v in recording.values("keypoints")] == [0, 1, 2, 3, 5, 6]  # the failing frame's inputs are there to repeat it
    with pytest.raises(StageError, match=r"rotation .*frame 6"):
        record(tmp_path / "b.mcap", toy_graph(rotation=ToyRotation(fails_at=6)), replay=Replay(recording, ("rotation",)), frames="6:7")


def test_memory_that_runs_out_in_a_stage_has_a_cure_that_helps(tmp_path):
    class Large(ToyRotation):
        def __call__(self, keypoints, previous, previous_pose):
            raise MemoryError("Unable to allocate 9 GiB")

    with pytest.raises(DataError) as error:
        record(tmp_path / "a.mcap", toy_graph(rotation=Large()))
    assert str(error.value) == ("memory: ran out (Unable to allocate 9 GiB); give the process more (ulimit -v), fewer threads=N, or smaller images")


def test_a_plugin_that_returns_the_wrong_thing_is_named(tmp_path):
    class Wrong(ToyRotation):
        def __call__(self, keypoints, previous, previous_pose):
            return keypoints

    with pytest.raises(StageError) as error:
        record(tmp_path / "a.mcap", toy_graph(rotation=Wrong()))
    assert str(error.value).startswith("rotation (Wrong), frame 0: TypeError: returned Keypoints, the slot's type is Rotation")


def test_unreadable_frames_are_skipped_and_counted(tmp_path):
    runner = record(tmp_path / "a.mcap", toy_graph(dataset=ToyDataset(length=30, unreadable=(7, 9, 12))))
    assert runner.result.unreadable == 3
    assert [v.index for v in Recording(tmp_path / "a.mcap").values("frames")] == [i for i in range(30) if i not in (7, 9, 12)]


def test_a_frame_that_has_become_unreadable_is_skipped_in_a_replay(tmp_path):
    record(tmp_path / "a.mcap", toy_graph(dataset=ToyDataset(length=30)))
    replay = Replay(Recording(tmp_path / "a.mcap"), ("keypoints",))
    record(tmp_path / "b.mcap", toy_graph(dataset=ToyDataset(length=30, unreadable=(7,))), replay=replay, topics=frozenset({"keypoints"}))
    before, after = ([v.index for v in Recording(tmp_path / name).values("keypoints")] for name in ("a.mcap", "b.mcap"))
    assert 7 in before and after == [index for index in before if index != 7]


def test_more_than_a_tenth_unreadable_is_an_error(tmp_path):
    with pytest.raises(DataError) as error:
        record(tmp_path / "a.mcap", toy_graph(dataset=ToyDataset(length=20, unreadable=(7, 9, 12))))
    assert str(error.value) == "dataset: 3 of 20 frames cannot be read; see the warnings above for the first file; the data set is damaged"


def test_timing_counts_every_call(tmp_path):
    runner = record(tmp_path / "a.mcap")
    summary = runner.timing.summary(2, 1.5, 0.25)
    assert (summary["frames"], summary["threads"], summary["wall_s"], summary["startup_s"], summary["fps"]) == (12, 2, 1.5, 0.25, 8.0)
    assert summary["stages"]["dataset"]["calls"] == 12 and summary["stages"]["rotation"]["calls"] == 10
    assert set(summary["frame_ms"]) == {"p50", "p95", "max"} and set(summary["stages"]["pose"]) == {"calls", "p50_ms", "p95_ms"}
