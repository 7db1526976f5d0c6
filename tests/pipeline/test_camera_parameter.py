"""The reserved parameter `camera`: the frame's in a run, the recorded one in a replay, which then needs no images."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.config import compose_run, graph_of
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import Camera, Keypoints, Pose, Rotation
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.replay import TOPICS, Replay
from trihedron.pipeline.run.runner import Runner

sys.path.insert(0, str(Path(__file__).parent))
from toys import CAMERA, ToyDataset, contents, toy_graph
from toys import TOPICS as TOY_TOPICS

SMALL = ["dataset.width=160", "dataset.height=120", "dataset.length=5"]


@dataclass(frozen=True)
class FocalLength:
    """A rotation whose covariance is the focal length of the frame's camera."""

    def __call__(self, keypoints: Keypoints, camera: Camera, previous_pose: Pose | None) -> Rotation | None:
        none = np.empty((0, 3, 3))
        found = np.eye(3) * camera.fx
        return Rotation(keypoints.index, keypoints.stamp_ns, np.eye(3), found, none, none, np.empty(0, np.int32), np.empty(0), "tracks")


class Zooming(ToyDataset):
    """Each frame has another focal length."""

    def __call__(self, index):
        frame = super().__call__(index)
        return None if frame is None else replace(frame, camera=replace(CAMERA, fx=100.0 + frame.index))


class Gone(Zooming):
    """Its folder was moved away."""

    def __len__(self):
        raise DataError("rooms/a", "does not exist", "give an existing folder")


def run(path, graph, replay=None):
    writer = RecordingWriter(path, {})
    try:
        runner = Runner(graph, replay=replay)
        for _ in runner.steps(writer, TOY_TOPICS):
            pass
    finally:
        writer.close()
    return runner


def test_a_stage_has_the_camera_of_each_frame_with_and_without_the_images(tmp_path):
    graph = toy_graph(("rotation",), dataset=Zooming(unreadable=(3,)), rotation=FocalLength())
    assert set(graph.stages["rotation"].inputs) == {"keypoints", "camera", "previous_pose"} and "camera" in graph.stages["rotation"].required
    run(tmp_path / "a.mcap", graph)
    found = {value.index: value.covariance[0, 0] for value in Recording(tmp_path / "a.mcap").values("rotation")}
    assert found == {index: 100.0 + index for index in range(12) if index % 5 != 4 and index != 3}  # no key points in each fifth
    gone = toy_graph(("rotation",), dataset=Gone(), rotation=FocalLength())
    runner = run(tmp_path / "b.mcap", gone, Replay(Recording(tmp_path / "a.mcap"), ("rotation",)))
    assert runner.computed == ("rotation",)
    assert contents(tmp_path / "b.mcap")["/rotation"] == contents(tmp_path / "a.mcap")["/rotation"]


def test_where_the_data_set_is_computed_its_camera_counts(tmp_path):
    run(tmp_path / "a.mcap", toy_graph(("rotation",), dataset=ToyDataset(), rotation=FocalLength()))
    replay = Replay(Recording(tmp_path / "a.mcap"), ("dataset", "rotation"))
    run(tmp_path / "b.mcap", toy_graph(("rotation",), dataset=Zooming(), rotation=FocalLength()), replay)
    assert [v.covariance[0, 0] for v in Recording(tmp_path / "a.mcap").values("rotation")][:3] == [CAMERA.fx] * 3
    assert [v.covariance[0, 0] for v in Recording(tmp_path / "b.mcap").values("rotation")][:3] == [100.0, 101.0, 102.0]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("camera")
    assert main(["run", *SMALL, f"out={folder}/run"]) == 0
    return folder / "run" / "run.mcap"


@pytest.mark.parametrize("stage", ["tracks", "pose", *(pytest.param(stage, marks=pytest.mark.slow) for stage in ("translation", "matches"))])
def test_a_stage_of_the_default_graph_that_reads_intrinsics_alone_needs_no_images(recorded, tmp_path, stage):
    """The recording holds no images, and the stages that found nothing all along (loop, relocalise) are not asked again."""
    replay = Replay(Recording(recorded), (stage,))
    assert replay.computed_stages(graph_of(compose_run(SMALL))) == (stage,)
    assert main(["run", f"replay={recorded}", f"only=[{stage}]", "threads=1", f"out={tmp_path}/again"]) == 0
    assert contents(tmp_path / "again" / "run.mcap")[f"/{stage}"] == contents(recorded)[f"/{stage}"]


@pytest.mark.parametrize("text", ["", "{", "3", '"pose"', "[3]", '[["loop"]]', '{"loop": 1}'])
def test_topics_that_a_strange_recording_states_are_not_believed(tmp_path, text):
    writer = RecordingWriter(tmp_path / "a.mcap", {TOPICS: text})
    writer.close()
    assert Replay(Recording(tmp_path / "a.mcap"), ()).topics == frozenset()


def test_stated_topics_are_known_stages_alone(tmp_path):
    writer = RecordingWriter(tmp_path / "a.mcap", {TOPICS: '["loop", "frames", "x"]'})
    writer.close()
    replay = Replay(Recording(tmp_path / "a.mcap"), ())
    assert replay.topics == {"loop"} and replay.reader("loop")(0) is None
