"""Budgets: when a word is taken and given back, the bytes of a replay, and the messages of wrong words."""

import json
import logging
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import trihedron as th
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.budgets import budget_of
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.app.execute import budget_line
from trihedron.pipeline.core.config import compose_run, graph_of
from trihedron.pipeline.core.errors import ConfigError, TrihedronError
from trihedron.pipeline.core.types import Effort, Frame, Keypoints
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.budget import LONGEST_PATIENCE, PATIENCE, WINDOW, Budget, Governor
from trihedron.pipeline.run.replay import Replay
from trihedron.pipeline.run.runner import Runner

sys.path.insert(0, str(Path(__file__).parent))
from toys import TOPICS, ToyDataset, ToyKeypoints, contents, toy_graph

WORDS = ("keypoints.features=600", "bundle=none")


@dataclass(frozen=True)
class NoKeypointsAtAll:
    """Key points without a row, from the frame alone."""

    def __call__(self, frame: Frame) -> Keypoints:
        return replace(ToyKeypoints()(replace(frame, index=0), np.random.default_rng(0)), index=frame.index, stamp_ns=frame.stamp_ns)


def fed(governor: Governor, latency_ms: float, count: int, start: int = 0) -> list[int]:
    """The levels of `count` frames of this latency, one after the other."""
    found = []
    for position in range(start, start + count):
        found.append(governor.level(position))
        assert governor.take(position, position, latency_ms) == found[-1]
    return found


def test_words_are_taken_one_after_the_other_and_no_more_than_there_are(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING, "trihedron"):
        levels = fed(Governor(Budget(20.0, WORDS, ())), 30.0, 4 * WINDOW)
    assert levels == WINDOW * [0] + WINDOW * [1] + 2 * WINDOW * [2]
    assert [record.getMessage() for record in caplog.records] == [
        "budget_ms: frames take 30.0 ms; after frame 9 with keypoints.features=600",
        "budget_ms: frames take 30.0 ms; after frame 19 with bundle=none",
    ]


def test_frames_within_the_budget_have_all_stages() -> None:
    assert fed(Governor(Budget(20.0, WORDS, ())), 20.0, 100) == 100 * [0]


def driven(governor: Governor, latency_ms: tuple[float, ...], count: int, start: int) -> list[int]:
    """The levels of `count` frames whose latency is that of their level."""
    return [fed(governor, latency_ms[governor.level(position)], 1, position)[0] for position in range(start, start + count)]


def test_a_word_is_dropped_when_what_it_saved_would_fit() -> None:
    """A word that takes 30 ms to 18 is dropped below 12 ms, the budget of 20 over 30 / 18; the next time after twice as many frames."""
    governor, heavy, light = Governor(Budget(20.0, WORDS, ())), (30.0, 18.0), (18.0, 11.0)
    assert driven(governor, heavy, 500, 0) == WINDOW * [0] + (500 - WINDOW) * [1]
    dropped = driven(governor, light, 100, 500)
    assert sum(dropped) <= WINDOW and dropped == sorted(dropped, reverse=True)
    taken = driven(governor, heavy, WINDOW, 600)
    assert taken == sorted(taken) and taken[-1] == 1
    assert sum(driven(governor, light, 500, 700)) in range(2 * PATIENCE - WINDOW, 2 * PATIENCE + 1)
    assert LONGEST_PATIENCE > 2 * PATIENCE


def test_a_word_that_saves_nothing_is_no_reason_to_hold_the_frame_longer_for_it() -> None:
    governor = Governor(Budget(20.0, WORDS, (), first=1))
    assert fed(governor, 25.0, WINDOW + 1)[-1] == 2


def test_frames_begun_before_a_decision_do_not_count_for_it() -> None:
    governor = Governor(Budget(20.0, WORDS, ()))
    early = [governor.level(position) for position in range(WINDOW + 5)]
    assert [governor.take(position, position, 30.0) for position in range(WINDOW + 5)] == early == (WINDOW + 5) * [0]
    assert fed(governor, 30.0, WINDOW, 50) == WINDOW * [1]


def run(path: Path, **more: object) -> Runner:
    runner = Runner(toy_graph(dataset=ToyDataset(60)), **more)
    writer = RecordingWriter(path, {"overrides": "[]"})
    for _ in runner.steps(writer, TOPICS):
        pass
    writer.close()
    return runner


def toy_budget(ms: float) -> Budget:
    changed = toy_graph(dataset=ToyDataset(60), keypoints=NoKeypointsAtAll())
    return Budget(ms, ("keypoints=other",), (changed.stages["keypoints"],))


@pytest.mark.parametrize("threads", [1, 3])
def test_a_replay_repeats_the_decisions(tmp_path: Path, threads: int) -> None:
    """No frame is done within a nanosecond: from some frame on the key points are those of the other plugin, in the replay as in the run."""
    ran = run(tmp_path / "run.mcap", threads=threads, budget=toy_budget(1e-6))
    levels = [effort.level for effort in Recording(tmp_path / "run.mcap").values("effort") if isinstance(effort, Effort)]
    assert levels == sorted(levels) and WINDOW <= levels.count(0) < 60 and len(levels) == 60
    empty = [value.index for value in Recording(tmp_path / "run.mcap").values("keypoints") if not len(value.pixels)]
    assert set(empty) == {0} | {k for k in range(60) if levels[k]}
    counts = [levels.count(0), levels.count(1)]
    assert ran.budgeted is not None and ran.budgeted.summary() == {"ms": 1e-6, "words": ["keypoints=other"], "frames": counts}
    for only in (("keypoints", "rotation"), ("rotation", "pose")):
        replay = Replay(Recording(tmp_path / "run.mcap"), only)
        again = run(tmp_path / "again.mcap", threads=4 - threads, replay=replay, budget=toy_budget(33.0))
        before, after = contents(tmp_path / "run.mcap"), contents(tmp_path / "again.mcap")
        assert {topic: before[topic] == after[topic] for topic in after} == dict.fromkeys(after, True)
        assert {"/effort", *(f"/{name}" for name in only)} <= set(after)
        assert again.budgeted is not None and again.budgeted.summary()["frames"] == counts


def test_within_the_budget_the_bytes_are_those_without_one(tmp_path: Path) -> None:
    run(tmp_path / "a.mcap")
    run(tmp_path / "b.mcap", budget=toy_budget(1e9))
    plain, kept = contents(tmp_path / "a.mcap"), contents(tmp_path / "b.mcap")
    assert kept.pop("/effort") and kept == plain


def test_a_replay_of_a_run_without_a_budget_has_none(tmp_path: Path) -> None:
    run(tmp_path / "run.mcap")
    with pytest.raises(ConfigError) as error:
        run(tmp_path / "again.mcap", replay=Replay(Recording(tmp_path / "run.mcap"), ("rotation",)), budget=toy_budget(33.0))
    cause = f"{tmp_path / 'run.mcap'} was recorded without a budget, and a replay takes the decisions of its run"
    assert str(error.value) == f"budget_ms: {cause}; leave it out"
    run(tmp_path / "b.mcap", budget=toy_budget(1e-6))
    with pytest.raises(ConfigError, match="budget_order: has 0 words, and up to 1 held in the recorded run; leave it out"):
        run(tmp_path / "c.mcap", replay=Replay(Recording(tmp_path / "b.mcap"), ("rotation",)), budget=Budget(33.0, (), ()))


def test_each_word_changes_the_stage_that_those_before_it_left() -> None:
    config = compose_run(["budget_ms=33", "budget_order=[keypoints.features=600,keypoints.levels=4,bundle=none]"])
    budget = budget_of(config, graph_of(config))
    assert budget is not None and [stage.name for stage in budget.stages] == ["keypoints", "keypoints", "bundle"]
    graph = graph_of(config)
    options = [(stage.plugin.features, stage.plugin.levels) for k in range(4) if (stage := budget.in_force(graph.stages["keypoints"], k))]
    assert options == [(1000, 8), (600, 8), (600, 4), (600, 4)]
    assert type(budget.in_force(graph.stages["bundle"], 3).plugin).__name__ == "NoBundle" and config.keypoints.features == 1000
    assert [changed.first for changed in budget.each()] == [1, 2, 3]


@pytest.mark.parametrize(
    ("words", "order"),
    [
        ([], ["keypoints.features=600", "bundle=none", "loop=none"]),
        (["keypoints.features=500", "without=loop"], ["bundle=none"]),
        (["keypoints=sift", "bundle=none"], ["loop=none"]),
    ],
)
def test_the_usual_order_is_what_saves_something(words: list[str], order: list[str]) -> None:
    config = compose_run(["budget_ms=33", *words])
    graph = graph_of(config)
    budget = budget_of(config, graph)
    assert budget is not None and list(budget.words) == order == list(config.budget_order)
    assert budget_of(compose_run([]), graph) is None


@pytest.mark.parametrize(
    ("order", "message"),
    [
        ("bundle", "'bundle' is no STAGE=PLUGIN or STAGE.OPTION=VALUE; give for example keypoints.features=500 or bundle=none"),
        ("keypoints.model=/a.onnx", "'keypoints.model=/a.onnx' is no STAGE=PLUGIN or STAGE.OPTION=VALUE; "),
        ("keypoint.features=5", "keypoint.features=5: 'keypoint' is no stage of this graph; did you mean 'keypoints'?"),
        ("keypoints.feature=5", "keypoints.feature=5: keypoints=orb has no option 'feature'; did you mean 'features'?"),
        ("dataset.length=5", "dataset.length=5: 'dataset' cannot be changed in mid-run; known: "),
        ("keypoints.features=many", "keypoints.features=many: Value 'many' "),
        ("translation=irls", "translation=irls: it reads previous_keypoints, which translation does not before; choose another plugin"),
    ],
)
def test_a_wrong_order_is_one_line(order: str, message: str) -> None:
    config = compose_run(["budget_ms=33", f"budget_order=[{order}]"])
    with pytest.raises(ConfigError) as error:
        budget_of(config, graph_of(config))
    assert str(error.value).startswith(f"budget_order: {message}")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["budget_ms=33", "graph=direct"],
            "budget_order: has 0 words; give 1 to 20, for example 'budget_order=[bundle=none]'",
        ),
        (["budget_ms=0"], "budget_ms: 0.0 is not a time; give milliseconds, for example budget_ms=33"),
        (["budget_ms=33", "budget_order=[keypoints.features=0]"], "keypoints.features: "),
        (["budget_ms=33", "budget_order=[bundle=nothing]"], "bundle: there is no plugin 'nothing' for the slot 'bundle'"),
    ],
)
def test_a_wrong_budget_is_one_line(words: list[str], message: str) -> None:
    config = compose_run(words)
    with pytest.raises(TrihedronError) as error:
        budget_of(config, graph_of(config))
    assert str(error.value).startswith(message)


def test_the_line_says_what_was_given_up() -> None:
    assert budget_line({"ms": 33.0, "words": list(WORDS), "frames": [300, 0, 0]}) == "budget 33 ms: 300 frames with all stages as configured"
    assert budget_line({"ms": 12.5, "words": list(WORDS), "frames": [10, 20, 30]}) == (
        "budget 12.5 ms: 10 frames with all stages as configured, 20 frames with keypoints.features=600, "
        "30 frames with bundle=none and what is before it"
    )


def test_pushed_frames_have_a_budget_too(tmp_path: Path) -> None:
    room = Synthetic(length=25, width=160, height=120)
    with th.Slam(room(0).camera, "budget_ms=0.001", "budget_order=[bundle=none]", out=tmp_path / "run") as slam:
        for k in range(25):
            slam.track(room(k).color, room(k).depth_m, 0.1 * (k + 1))
    assert Recording(tmp_path / "run" / "run.mcap").value("effort", int(2.4e9)) is not None
    assert json.loads((tmp_path / "run" / "timing.json").read_text())["budget"]["words"] == ["bundle=none"]


def test_what_is_saved_of_pushed_frames_has_the_decisions(tmp_path: Path) -> None:
    room = Synthetic(length=14, width=160, height=120)
    with th.Slam(room(0).camera, "budget_ms=0.001", "budget_order=[bundle=none]", history=5) as slam:
        for k in range(14):
            slam.track(room(k).color, room(k).depth_m, 0.1 * (k + 1))
        slam.save(tmp_path / "last.mcap")
    recording = Recording(tmp_path / "last.mcap")
    assert [value.index for value in recording.values("effort")] == [value.index for value in recording.references] == list(range(9, 14))


@pytest.mark.slow
def test_the_program_keeps_a_budget_and_replays_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["dataset.width=160", "dataset.height=120", "dataset.length=40"]
    assert main(["run", *small, "budget_ms=0.001", f"out={tmp_path / 'a'}"]) == 0
    printed = capsys.readouterr()
    assert "trihedron: warning: budget_ms: frames take " in printed.err and "\nbudget 0.001 ms: " in printed.out
    assert main(["run", f"replay={tmp_path / 'a' / 'run.mcap'}", "threads=1", f"out={tmp_path / 'b'}"]) == 0
    assert main(["diff", str(tmp_path / "a" / "run.mcap"), str(tmp_path / "b" / "run.mcap")]) == 0
