"""Graphs side by side: which stages change, what is shared, and the same bytes as alone."""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numba
import numpy as np
import pytest

from trihedron.pipeline.core.errors import StageError
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.recorder import Recorder
from trihedron.pipeline.run.replay import Replay
from trihedron.pipeline.run.runner import Runner
from trihedron.pipeline.run.side_by_side import SideBySide, changed_stages, equivalence, swapped_stages, vertices_of, with_one_dataset

sys.path.insert(0, str(Path(__file__).parent))
from toys import TOPICS, ToyDataset, ToyKeypoints, ToyNormals, ToyRotation, contents, toy_graph

ALL = ("trajectory", "normals", "surface")


@dataclass(frozen=True)
class CountedNormals(ToyNormals):
    """Normals that are not recorded, and count their calls."""

    calls: ClassVar[list[int]] = []

    def __call__(self, frame):
        self.calls.append(frame.index)
        return super().__call__(frame)


@dataclass(frozen=True)
class CompiledKeypoints(ToyKeypoints):
    """Key points of a plugin that calls a function which is compiled in the last frame only; it measures the CPU time of its calls."""

    seconds: ClassVar[list[float]] = []

    def __call__(self, frame, rng):
        began = time.thread_time()
        if frame.index == 11:
            numba.njit(lambda values: np.sort(values) + values.std())(np.ones(3))
        self.seconds.append(time.thread_time() - began)
        return super().__call__(frame, rng)


@dataclass(frozen=True)
class FewerKeypoints(ToyKeypoints):
    """Key points of even frames alone."""

    def __call__(self, frame, rng):
        return super().__call__(frame, rng) if frame.index % 2 == 0 else None


@dataclass(frozen=True)
class FromNormals(ToyKeypoints):
    """Keypoints that read the frame: two of them compute alike."""


def record(path, graph, replay=None, topics=TOPICS):
    writer = RecordingWriter(path, {"overrides": "[]"})
    for _ in Runner(graph, seed=3, threads=2, replay=replay).steps(writer, topics):
        pass
    writer.close()
    return path


def test_what_changes_is_what_follows_over_wires_and_delayed_wires():
    base = toy_graph()
    assert changed_stages([base, toy_graph()]) == frozenset()
    assert changed_stages([base, toy_graph(rotation=ToyRotation(gain=2.0))]) == {"rotation", "pose", "map", "surface"}
    assert changed_stages([base, toy_graph(keypoints=FromNormals())]) == {"keypoints", "rotation", "pose", "map", "surface"}
    assert changed_stages([base, toy_graph(normals=ToyNormals(2.0))]) == {"normals"}  # nothing reads them
    assert swapped_stages([base, toy_graph(rotation=ToyRotation(gain=2.0), keypoints=FromNormals())]) == {"rotation", "keypoints"}


def test_stages_are_shared_by_those_that_agree():
    graphs = [toy_graph(), toy_graph(rotation=ToyRotation(gain=2.0)), toy_graph(rotation=ToyRotation(gain=2.0), normals=ToyNormals(2.0))]
    first, second, third = equivalence([vertices_of(graph) for graph in graphs])
    assert first["keypoints"] == second["keypoints"] == third["keypoints"]
    assert first["rotation"] != second["rotation"] == third["rotation"] and second["pose"] == third["pose"] != first["pose"]
    assert first["normals"] == second["normals"] != third["normals"]


def test_equal_data_sets_are_one():
    graphs = [toy_graph(), toy_graph(rotation=ToyRotation(gain=2.0)), toy_graph(dataset=ToyDataset(3))]
    first, second, third = with_one_dataset(graphs)
    assert first.stages["dataset"] is second.stages["dataset"] is graphs[0].stages["dataset"]
    assert third.stages["dataset"] is graphs[2].stages["dataset"]
    assert second.stages["rotation"] is graphs[1].stages["rotation"] and list(second.stages) == list(graphs[1].stages)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("feedback", [False, True])
def test_side_by_side_gives_the_bytes_of_each_alone(tmp_path, threads, feedback):
    source = record(tmp_path / "source.mcap", toy_graph())
    graphs = [toy_graph(), toy_graph(rotation=ToyRotation(gain=2.0)), toy_graph(rotation=ToyRotation(gain=3.0), keypoints=FromNormals())]
    only = tuple(sorted((swapped_stages if feedback else changed_stages)(graphs)))
    runners = [Runner(graph, seed=3, threads=threads, replay=Replay(Recording(source), only, feedback)) for graph in graphs]
    writers = [RecordingWriter(tmp_path / f"{number}.mcap", {"overrides": "[]"}) for number in range(3)]
    for runner, writer in zip(runners, writers):
        runner.sinks = (Recorder(writer, runner.plan, frozenset(only), False, None),)
    together = SideBySide(runners, threads)
    assert [index for index, _ in together.steps()] == list(range(12))
    for number, (writer, graph) in enumerate(zip(writers, graphs)):
        writer.close()
        alone = record(tmp_path / f"alone{number}.mcap", graph, Replay(Recording(source), only, feedback), frozenset(only))
        assert contents(tmp_path / f"{number}.mcap") == contents(alone)
    if not feedback:
        whole = contents(record(tmp_path / "whole.mcap", graphs[2]))
        assert all(contents(tmp_path / "2.mcap")[f"/{topic}"] == whole[f"/{topic}"] for topic in only)


def test_the_time_of_a_swap_is_without_that_of_the_compiler(tmp_path):
    source = record(tmp_path / "source.mcap", toy_graph())
    together = SideBySide([Runner(toy_graph(keypoints=CompiledKeypoints()), replay=Replay(Recording(source), ("keypoints",)))], threads=2)
    assert [index for index, _ in together.steps()] == list(range(12))
    ms = together.cpu_ms_of_frames([together.node_of[0]["keypoints"]])
    assert 0 < ms[11] < 0.5 * 1e3 * CompiledKeypoints.seconds[-1]


@pytest.mark.parametrize("wire", ["rotation@prev", "rotation@3"])
def test_recorded_feedback_is_as_old_as_the_wire_says(tmp_path, wire):
    """A frame of k key points adds k to the total that the wire brings, with gain 2 it adds 2 k: to the recorded total of an earlier frame, not of
    this one or of its own. Every fifth frame has none."""
    wiring = {"rotation": {"previous": wire}}
    source, recorded, expected = record(tmp_path / "source.mcap", toy_graph(wiring=wiring)), {}, {}
    for k in (k for k in range(12) if k % 5 != 4):
        before = recorded.get(k - 3 if wire == "rotation@3" else max(recorded, default=None), 0.0)
        recorded[k], expected[k] = k + before, 2 * k + before
    double = toy_graph(rotation=ToyRotation(gain=2.0), wiring=wiring)
    again = record(tmp_path / "again.mcap", double, Replay(Recording(source), ("rotation",), True), frozenset({"rotation"}))
    for path, totals in ((source, recorded), (again, expected)):
        assert {value.index: value.covariance[0, 0] for value in Recording(path).values("rotation")} == totals


def test_with_recorded_feedback_a_stage_sees_nothing_that_another_computes(tmp_path):
    """Fewer key points change the total of the rotation, but not one that is computed on the recorded key points."""
    source = record(tmp_path / "source.mcap", toy_graph())
    changed = toy_graph(keypoints=FewerKeypoints())
    found = {}
    for feedback in (False, True):
        replay = Replay(Recording(source), ("keypoints", "rotation"), feedback)
        found[feedback] = contents(record(tmp_path / f"{feedback}.mcap", changed, replay, frozenset({"keypoints", "rotation"})))
    recorded = contents(source)
    assert found[True]["/keypoints"] == found[False]["/keypoints"] != recorded["/keypoints"]
    assert found[True]["/rotation"] == recorded["/rotation"] != found[False]["/rotation"]


def test_what_is_not_recorded_is_computed_once(tmp_path):
    source = record(tmp_path / "source.mcap", toy_graph(keypoints=FromNormals()), topics=TOPICS - {"keypoints"})
    CountedNormals.calls.clear()
    graphs = [toy_graph(normals=CountedNormals(), rotation=ToyRotation(gain=gain)) for gain in (1.0, 2.0, 3.0)]
    runners = [Runner(graph, seed=3, threads=2, replay=Replay(Recording(source), ("normals", "rotation"))) for graph in graphs]
    together = SideBySide(runners, 2)
    for _ in together.steps():
        pass
    assert sorted(CountedNormals.calls) == list(range(12))
    assert {name: together.users[together.node_of[0][name]] for name in ("normals", "keypoints", "rotation")} == {
        "normals": 3, "keypoints": 3, "rotation": 1,
    }  # fmt: skip
    assert set(together.cpu_s) == {node for nodes in together.node_of for node in nodes.values()}
    assert all(runner.timing.summary(2, 1.0, 0.0)["stages"]["normals"]["calls"] == 12 for runner in runners)


def test_a_stage_that_fails_is_named(tmp_path):
    source = record(tmp_path / "source.mcap", toy_graph(dataset=ToyDataset(length=6)))
    graphs = [toy_graph(dataset=ToyDataset(length=6)), toy_graph(dataset=ToyDataset(length=6), rotation=ToyRotation(fails_at=3))]
    runners = [Runner(graph, threads=1, replay=Replay(Recording(source), ("rotation",))) for graph in graphs]
    with pytest.raises(StageError) as error:
        for _ in SideBySide(runners, 1).steps():
            pass
    assert str(error.value) == "rotation (ToyRotation), frame 3: ValueError: matrix is singular; leave out the value that chose it"


def test_a_fold_is_finished_for_each(tmp_path):
    source = record(tmp_path / "source.mcap", toy_graph())
    graphs = [toy_graph(), replace(toy_graph(), outputs=ALL)]
    runners = [Runner(graph, threads=2, replay=Replay(Recording(source), ("surface",))) for graph in graphs]
    for _ in SideBySide(runners, 2).steps():
        pass
    assert [len(runner.result.folds["surface"].vertices_m) for runner in runners] == [10, 10]
