"""Runs in real time: frames are dropped, never queued; what was taken can be replayed."""

import json
import sys
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.types import Frame, Keypoints, Map, Pose, Rotation
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run import live
from trihedron.pipeline.run.live import Arrival, Pace, Playback
from trihedron.pipeline.run.replay import Replay
from trihedron.pipeline.run.runner import Runner

sys.path.insert(0, str(Path(__file__).parent))
from toys import CAMERA, TOPICS, ToyDataset, ToyKeypoints, ToyPose, contents, toy_graph

FAST = replace(CAMERA, fps=200.0)


@dataclass(frozen=True)
class FastDataset(ToyDataset):
    """200 frames a second, or as many as it is told."""

    fps: float = 200.0

    def __call__(self, index: int) -> Frame | None:
        frame = super().__call__(index)
        return replace(frame, camera=replace(CAMERA, fps=self.fps)) if frame is not None else None


class Clock:
    """The time of a live source, in place of the module `time`: it passes only in `sleep`, by as much, whatever the machine does."""

    def __init__(self) -> None:
        self._now, self._lock = 0.0, threading.Lock()

    def perf_counter(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        with self._lock:
            self._now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(live, "time", made)
    return made


@dataclass(frozen=True)
class SlowPose:
    """Takes `seconds` of the live source's clock a frame."""

    seconds: float = 0.02

    def __call__(self, frame: Frame, rotation: Rotation, previous: Pose | None, map: Map | None) -> Pose | None:
        live.time.sleep(self.seconds)
        return ToyPose()(frame, rotation, previous, map)


def run(
    tmp_path: Path, pace: Pace, length: int = 60, topics: frozenset[str] = TOPICS, **plugins: object
) -> tuple[Runner, Path, dict[int, float]]:  # fmt: skip
    """The runner after its run, the recording, and the time at which the pose at each position was done."""
    done: dict[int, float] = {}

    def report(position: int, stage: str, value: object) -> None:
        if stage == "pose" and value is not None:
            done[position] = live.time.perf_counter()

    runner = Runner(toy_graph(**{"dataset": FastDataset(length), **plugins}), threads=2, pace=pace, on_value=report)
    path = tmp_path / f"{pace.value}.mcap"
    writer = RecordingWriter(path, {"overrides": "[]"})
    for _ in runner.steps(writer, topics, embed_frames="dataset" in topics):
        pass
    writer.close()
    return runner, path, done


def taken(path: Path) -> list[int]:
    return [value.index for value in Recording(path).values("frames")]


def latencies_s(runner: Runner, done: dict[int, float]) -> list[float]:
    """From the arrival of each frame to its pose."""
    assert runner.feed is not None
    return [done[position] - runner.feed.came_s[position] for position in sorted(done)]


def test_a_late_run_drops_frames_and_stays_on_time(tmp_path: Path, clock: Clock) -> None:
    """60 frames in 0.3 s for a stage that takes 20 ms: every fourth at best. A frame waits for those in flight before it, two of two threads."""
    runner, path, done = run(tmp_path, Pace.live, pose=SlowPose(0.02))
    assert runner.feed is not None
    numbers = taken(path)
    assert numbers == runner.feed.numbers == sorted(set(numbers)) and numbers[0] == 0 and numbers[-1] == 59
    summary = runner.feed.summary({})
    assert summary["came"] == 60 and summary["taken"] == len(numbers) < 45 and summary["dropped"] == 60 - len(numbers)
    assert [pose.index for pose in runner.result.poses] == [number for number in numbers if number % 5 != 4]  # where there are key points
    assert max(latencies_s(runner, done)) < 0.15  # at the end of a queue: 900 ms


def test_every_fourth_frame_comes_at_a_quarter_of_the_rate(tmp_path: Path, clock: Clock) -> None:
    """Frames 2, 6, … of 200 Hz, one every 20 ms, for a stage that takes 30 ms: some are dropped, and the recording has the numbers of the others."""
    graph = toy_graph(dataset=FastDataset(30, start=2, stride=4), pose=SlowPose(0.03))
    runner = Runner(graph, threads=2, pace=Pace.live, frames="2:122:4")
    for _ in runner.steps(None, frozenset()):
        pass
    assert runner.feed is not None
    numbers, summary = runner.feed.numbers, runner.feed.summary({})
    assert numbers[0] == 2 and numbers[-1] == 118 and {number % 4 for number in numbers} == {2}
    assert summary["came"] == 30 and summary["taken"] == len(numbers) < 30
    assert runner.feed.came_s == pytest.approx([(number - 2) / 200.0 for number in numbers])


def test_a_run_in_time_takes_every_frame_when_it_comes(tmp_path: Path, clock: Clock) -> None:
    runner, path, _ = run(tmp_path, Pace.live, dataset=FastDataset(15, fps=20.0))
    assert runner.feed is not None and taken(path) == list(range(15))
    assert runner.feed.came_s == pytest.approx([k / 20.0 for k in range(15)]) and clock.perf_counter() == pytest.approx(14 / 20.0)


def test_in_real_time_nothing_is_dropped_and_a_queue_grows(tmp_path: Path, clock: Clock) -> None:
    runner, path, done = run(tmp_path, Pace.real_time, length=30, pose=SlowPose(0.015))
    assert runner.feed is not None and taken(path) == list(range(30))
    assert runner.feed.came_s == pytest.approx([k / 200.0 for k in range(30)])
    assert clock.perf_counter() >= 24 * 0.015 - 1e-9  # every fifth frame has no key points, so no pose
    assert latencies_s(runner, done)[-1] > 0.15  # the last pose is that of frame 28, which came after 140 ms and was done after 360


@pytest.mark.parametrize("threads", [1, 3])
def test_what_was_taken_is_replayed_bit_for_bit(tmp_path: Path, threads: int, clock: Clock) -> None:
    """All stages from the embedded frames, and single ones, of the whole recording and of its second half."""
    topics = TOPICS | {"dataset"}
    _, path, _ = run(tmp_path, Pace.live, topics=topics, pose=SlowPose(0.012))
    numbers = taken(path)
    assert 1 < len(numbers) < 60
    expected = contents(path)
    for only, frames in ((tuple(TOPICS), ""), (("pose",), ""), (("rotation",), f"{numbers[len(numbers) // 2]}:")):
        graph = toy_graph(dataset=FastDataset(60))
        runner = Runner(graph, threads=threads, replay=Replay(Recording(path), only, recorded_feedback=bool(frames)), frames=frames)
        again = tmp_path / "again.mcap"
        writer = RecordingWriter(again, {"overrides": "[]"})
        for _ in runner.steps(writer, frozenset(only)):
            pass
        writer.close()
        found = contents(again)
        for topic in only:
            whole = expected[f"/{topic}"]
            assert found[f"/{topic}"] == (whole[-len(found[f"/{topic}"]) :] if frames else whole), topic
        assert len(found["/frames"]) == len(numbers) - (len(numbers) // 2 if frames else 0)


@dataclass(frozen=True)
class HalfDead:
    """A camera that ends after three frames, at numbers 0, 3 and 5."""

    asked: tuple[int, ...] = (0, 3, 5)

    def __len__(self) -> int:
        return 1 << 30

    def __call__(self, index: int) -> Frame | None:
        return replace(ToyDataset(100)(index), camera=FAST)

    def truth(self) -> None:
        return None

    def start(self) -> None:
        """Nothing to do."""

    def stop(self) -> None:
        """Nothing to do."""

    def wait(self, after: int) -> Arrival | None:
        later = [number for number in self.asked if number > after]
        return Arrival(later[0], time.perf_counter()) if later else None


def test_a_camera_that_ends_ends_the_run(tmp_path: Path) -> None:
    runner = Runner(toy_graph(dataset=HalfDead()), threads=2)
    assert [step.index for step in runner.steps(None, frozenset())] == [0, 3, 5]
    assert [pose.index for pose in runner.result.poses] == [0, 3, 5]
    assert [int(x) for x in runner.result.folds["surface"].vertices_m[:, 0]] == [0, 3, 5]
    assert list(Runner(toy_graph(dataset=HalfDead(())), threads=2).steps(None, frozenset())) == []


@dataclass(frozen=True)
class FailingKeypoints(ToyKeypoints):
    def __call__(self, frame: Frame) -> Keypoints | None:
        raise ValueError("no memory")


def test_a_stage_that_fails_is_named_with_the_frame_it_had(tmp_path: Path) -> None:
    runner = Runner(toy_graph(dataset=HalfDead((7, 8)), keypoints=FailingKeypoints()), threads=2)
    with pytest.raises(Exception, match=r"keypoints \(FailingKeypoints\), frame 7: ValueError: no memory"):
        list(runner.steps(None, frozenset()))


def test_playback_gives_the_newest_or_the_next(clock: Clock) -> None:
    playback = Playback(10, 100.0)
    assert playback.wait(-1) == Arrival(0, 0.0)
    clock.sleep(0.055)
    assert playback.wait(0) == Arrival(5, 0.05)  # 1 to 4 were dropped
    assert playback.wait(5) == Arrival(6, 0.06) and clock.perf_counter() == pytest.approx(0.06)  # waited for
    assert playback.wait(9) is None
    patient = Playback(10, 100.0, drop=False)
    clock.sleep(1.0)
    began = clock.perf_counter()
    assert [patient.wait(k) for k in range(-1, 9)] == [Arrival(k, began + k * 0.01) for k in range(10)]
    patient.start()
    assert patient.wait(-1) == Arrival(0, clock.perf_counter())


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "live=true", "real_time=true", f"out={tmp_path / 'a'}"]) == 1
    assert capsys.readouterr().err == "trihedron: real_time: a live run is in real time, and drops frames; give one of the two\n"


@pytest.mark.slow
def test_the_room_live_and_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The default graph at the room's 30 frames/s: what it says, and the same bytes of every stage in a replay from the data set."""
    live, again = tmp_path / "live", tmp_path / "again"
    assert main(["run", "live=true", "dataset.frames=0:60", f"out={live}"]) == 0
    said = capsys.readouterr().out
    assert "live: 60 frames came, " in said and "dropped; a pose is ready " in said
    timing = json.loads((live / "timing.json").read_text())
    assert timing["live"]["taken"] + timing["live"]["dropped"] == 60 and timing["live"]["latency_ms"] == timing["frame_ms"]
    assert main(["run", f"replay={live / 'run.mcap'}", f"out={again}"]) == 0
    first, second = contents(live / "run.mcap"), contents(again / "run.mcap")
    assert first.keys() == second.keys() and all(first[topic] == second[topic] for topic in first)
    print(timing["live"], json.loads((live / "metrics.json").read_text())["final"]["ate_rmse_m"])
