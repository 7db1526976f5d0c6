"""Runs a graph over a data set or a recording: owns the state, measures, records, and says what went wrong where.

Which stages compute and which are read: without a recording everything computes. In a replay the stages of `only` compute; a wire from any other
stage is read from the file, and where the file lacks its topic the stage computes after all, back to the frames if need be.
"""

from __future__ import annotations

import logging
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError, RecordingError, StageError, TrihedronError
from trihedron.pipeline.core.graph import Graph, Stage
from trihedron.pipeline.core.options import frame_range
from trihedron.pipeline.core.registry import check_value
from trihedron.pipeline.core.slots import CAMERA
from trihedron.pipeline.core.types import Frame, FrameReference, Map, Pose, Trajectory, Value
from trihedron.pipeline.core.wires import Wire
from trihedron.pipeline.record.foxglove import View
from trihedron.pipeline.record.recording import FRAMES_TOPIC, RecordingWriter, TopicReader
from trihedron.pipeline.run.frame_validation import Intake
from trihedron.pipeline.run.interrupts import Interrupts
from trihedron.pipeline.run.live import Pace, feed_of, is_camera
from trihedron.pipeline.run.memory import give_back
from trihedron.pipeline.run.replay import Replay, Result, Step
from trihedron.pipeline.run.scheduler import Node, NodeFailure, NoMoreFrames, Scheduler, single_threaded_libraries
from trihedron.pipeline.run.state import Keeper, Memory, reaches, recorded_memory
from trihedron.pipeline.run.timing import Timing, resident_mb

log = logging.getLogger("trihedron")
RECORDED = "recorded:"  # prefix of the node that reads a topic from the file
UNREADABLE_SHARE = 0.1
GIVE_BACK_EVERY = 1000  # frames; it takes some 10 ms
FRAME_TAKEN = "dataset:"  # input of every stage of a live run: which frame it is must be known first


class Runner:
    """One run of a graph. `steps` does the work, frame by frame; `result` and `timing` hold what it found."""

    def __init__(
        self,
        graph: Graph,
        seed: int = 0,
        threads: int = 2,
        replay: Replay | None = None,
        frames: str = "",
        remembered: Callable[[int], Memory] | None = None,
        pace: Pace = Pace.none,
    ) -> None:
        """`remembered` says what is known before the frame of a given number, `pace` when frames may be asked for."""
        self.graph, self.seed, self.threads, self.replay = graph, seed, threads, replay
        self.result, self.timing, self.computed = Result(), Timing(), self._computed()
        self.feed = feed_of(graph.stages["dataset"].plugin, pace) if replay is None else None
        self.indices, self._stamps = self._frames(frames)
        self.count = len(self.indices)  # of frames, at most
        self._first = frame_range(frames)[0]
        self._memory = remembered(self.indices[0]) if remembered is not None else Memory()
        reach = reaches(graph.stages[name] for name in self.computed)
        if replay is not None:
            self._memory = self._memory.updated(recorded_memory(replay.recording, reach, self.indices[0]), RECORDED)
        self.keeper = Keeper(reach, self._memory, self.indices[0])
        self.result.map = self._loaded_map()
        self.result.loaded_keyframes = len(self.result.map.keyframes) if self.result.map is not None else 0
        self._references = TopicReader(replay.recording, FRAMES_TOPIC) if replay is not None else None
        self._asked_after = {name: _asked_after(graph, name) for name in self.computed}
        self._intake = Intake(self._stamps.copy(), self.count if self.feed is None else 0)
        self._fold_states: dict[str, Any] = {}
        self._calls_ms: dict[int, dict[str, float]] = {}
        self._handed_over: dict[int, float] = {}
        self._latency_ms: dict[int, float] = {}

    def _computed(self) -> tuple[str, ...]:
        """The stages that run, in order; the rest is read from the recording."""
        if self.replay is None:
            return tuple(self.graph.stages)
        recorded, pending, found = self.replay.recording.topics, list(self.replay.only), set()
        while pending:
            name = pending.pop()
            if name not in found:
                found.add(name)
                pending += [w.topic for p, w in self.graph.stages[name].inputs.items() if w.topic not in recorded and p != CAMERA]
        return tuple(name for name in self.graph.stages if name in found)

    def _frames(self, frames: str) -> tuple[Sequence[int], dict[int, int]]:
        """The frame numbers to go through, and the stamps known beforehand."""
        first, stop = frame_range(frames)
        if self.replay is not None and "dataset" in self.computed and "dataset" not in self.replay.only:
            self._check_frames_are_there(self.replay)
        if self.replay is None:
            count = len(self.graph.stages["dataset"].plugin)
            return range(first, first + count), {}
        references = [v for v in self.replay.recording.values(FRAMES_TOPIC) if isinstance(v, FrameReference)]
        known = {reference.index: reference.stamp_ns for reference in references}
        self.result.fps = references[0].camera.fps if references else self.result.fps
        chosen = {i: stamp for i, stamp in known.items() if i >= first and (stop is None or i < stop)}
        if not chosen:
            raise RecordingError(str(self.replay.recording.path), f"has none of the frames '{frames}'", "give another dataset.frames")
        return list(chosen), chosen

    def _check_frames_are_there(self, replay: Replay) -> None:
        """Raise RecordingError when a replay needs the images, the recording does not embed them, and the data set cannot be opened."""
        try:
            if is_camera(self.graph.stages["dataset"].plugin):
                raise DataError("dataset", "a camera shows no frame twice")
            len(self.graph.stages["dataset"].plugin)
        except DataError as error:
            cause = f"does not embed the frames that {' and '.join(replay.only)} must see, and the data set is gone ({error.place}: {error.cause})"
            raise RecordingError(str(replay.recording.path), cause, "give its new place as dataset.path=FOLDER") from error

    def steps(
        self, writer: RecordingWriter | None, topics: frozenset[str], embed_frames: bool = False, truth: Trajectory | None = None
    ) -> Iterator[Step]:
        """Run, yielding each finished frame; values of `topics` go to the writer, with what viewers show, errors by `truth` too.
        Raises TrihedronError (StageError names stage and frame)."""
        before, first = self._memory, self.indices[0]
        recent = {topic: {index - first: value for index, value in values.items()} for topic, values in before.recent.items()}
        scheduler = Scheduler(self._nodes(), self.threads, self.threads, before.held, recent)
        view = View(truth)
        try:
            with single_threaded_libraries(), self._feeding(), Interrupts() as interrupts:
                for position, values in scheduler.run(self.count):
                    with interrupts.held():
                        if self._account(position, values) and writer is not None:
                            self._record(writer, view, position, values, topics, embed_frames)
                    for times in (self._calls_ms, self._latency_ms, self._handed_over):
                        times.pop(position, None)
                    self._stamps.pop(self.indices[position], None)
                    if (position + 1) % GIVE_BACK_EVERY == 0:
                        give_back()
                    yield Step(position, self.count, self.indices[position], values)
                if "map" not in self.computed:
                    self.result.map = self._recorded_map()
                for name in self.computed:
                    if self.graph.stages[name].fold:
                        self._finish_fold(name, writer, view, name in topics)
        except NodeFailure as failure:
            raise self._explain(failure, writer) from failure.__cause__

    @contextmanager
    def _feeding(self) -> Iterator[None]:
        """Frames of a camera are numbered as they are taken."""
        if self.feed is None:
            yield
            return
        self.feed.start()
        self.indices = self.feed.numbers
        try:
            yield
        finally:
            self.feed.stop()

    def _nodes(self) -> list[Node]:
        readers: dict[str, Node] = {}
        stages = [self._stage_node(self.graph.stages[name], readers) for name in self.computed]
        return [*readers.values(), *stages]

    def _stage_node(self, stage: Stage, readers: dict[str, Node]) -> Node:
        inputs = {}
        for parameter, wire in stage.inputs.items():
            from_file = wire.topic not in self.computed or (wire.delay and self._recorded_feedback(wire.topic))
            topic = FRAMES_TOPIC if parameter == CAMERA else wire.topic
            inputs[parameter] = Wire(RECORDED + topic, wire.delay) if from_file else wire
            if from_file and RECORDED + topic not in readers:
                readers[RECORDED + topic] = self._reader_node(topic)
        if self.feed is not None and stage.name != "dataset":
            inputs[FRAME_TAKEN] = Wire("dataset")
        if stage.name == "dataset":
            waits = self.feed is not None
            return Node(stage.name, lambda p, _: self._intake(p, lambda at: self._call(stage, at, {}), lambda: self.indices[p]), inputs, True, waits)
        return Node(stage.name, lambda position, values: self._call(stage, position, values), inputs, stage.fold)

    def _recorded_feedback(self, topic: str) -> bool:
        return self.replay is not None and self.replay.recorded_feedback and topic in self.replay.recording.topics

    def _reader_node(self, topic: str) -> Node:
        assert self.replay is not None
        reader = TopicReader(self.replay.recording, topic)
        return Node(RECORDED + topic, lambda position, _: reader.at(self.indices[position]), {}, ordered=True)

    def _call(self, stage: Stage, position: int, values: Mapping[str, Any]) -> Value | None:
        """Skip, seed, time and check one call."""
        reads_frames = stage.name == "dataset"
        if reads_frames and self.feed is not None and self.feed.take() is None:
            raise NoMoreFrames
        for parameter in stage.required:
            if values[parameter] is None:
                return None
        arguments = {**dict.fromkeys(stage.absent), **values}
        arguments.pop(FRAME_TAKEN, None)
        if CAMERA in arguments:
            arguments[CAMERA] = arguments[CAMERA].camera  # of a frame, or of the recording's reference to it
        if stage.wants_rng:
            arguments["rng"] = np.random.default_rng([self.seed, self.indices[position], zlib.crc32(stage.name.encode())])
        if reads_frames:
            arguments["index"] = self.indices[position] - self._first
        began = time.perf_counter()
        if stage.fold:
            state = self._fold_states[stage.name] if stage.name in self._fold_states else stage.plugin.start()
            self._fold_states[stage.name] = stage.plugin.add(state, **arguments)
            value = None
        else:
            value = stage.plugin(**arguments)
        ended = time.perf_counter()
        self._calls_ms.setdefault(position, {})[stage.name] = 1e3 * (ended - began)
        if reads_frames:
            self._handed_over[position] = ended if self.feed is None else self.feed.came_s[position]
        elif stage.name == "pose":
            self._latency_ms[position] = 1e3 * (ended - self._handed_over.get(position, began))
        if value is not None:
            check_value(stage.name, value, self.indices[position])
        return value

    def _account(self, position: int, values: Mapping[str, Any]) -> bool:
        """Take what a frame gave into the results; False where it cannot be read."""
        self.keeper.see(self.indices[position], values)
        calls = self._calls_ms.setdefault(position, {})
        for name, ms in calls.items():
            self.timing.add_call(name, ms)
        if "dataset" in values and values["dataset"] is None:
            self.result.unreadable += position not in self._intake.late
            if self.result.unreadable > UNREADABLE_SHARE * self.count:
                cause = f"{self.result.unreadable} of {self.count} frames cannot be read"
                raise DataError("dataset", cause, "see the warnings above for the first file; the data set is damaged")
            return False
        self.timing.add_frame(self._latency_ms.setdefault(position, sum(calls.values())))
        first = next((v for v in values.values() if isinstance(v, Value) and v.index == self.indices[position]), None)
        self._stamps.setdefault(self.indices[position], first.stamp_ns if first is not None else 0)
        self.result.stamps_ns.append(self._stamps[self.indices[position]])
        if isinstance(frame := values.get("dataset"), Frame):
            self.result.fps = frame.camera.fps
        if isinstance(pose := values.get("pose"), Pose):
            self.result.poses.append(pose)
        if isinstance(map := values.get("map"), Map):
            self.result.map = map
        return True

    def _record(
        self, writer: RecordingWriter, view: View, position: int, values: Mapping[str, Any], topics: frozenset[str], embed_frames: bool
    ) -> None:
        stamp, frame = self._stamps[self.indices[position]], values.get("dataset")
        if isinstance(frame, Frame):
            writer.write(FRAMES_TOPIC, FrameReference(frame.index, frame.stamp_ns, frame.camera))
        elif self._references is not None:
            self._copy_reference(writer, self.indices[position])
        for name in self.computed:
            value = values.get(name)
            if isinstance(value, Value):
                if name in topics and (name != "dataset" or embed_frames):
                    writer.write(name, value, self._asked_after[name])
                writer.show(view, value, stamp)
        writer.write_timing(self.indices[position], stamp, self._latency_ms[position], self._calls_ms[position], resident_mb())

    def _copy_reference(self, writer: RecordingWriter, index: int) -> None:
        assert self._references is not None
        reference = self._references.at(index)
        if reference is not None:
            writer.write(FRAMES_TOPIC, reference)

    def _loaded_map(self) -> Map | None:
        loaded = self._memory.held.get("map")
        return loaded if isinstance(loaded, Map) else None

    def _recorded_map(self) -> Map | None:
        """The map after the last frame, where it was read rather than computed."""
        if self.replay is None or "map" not in self.replay.recording.topics:
            return self.result.map
        reader = TopicReader(self.replay.recording, "map")
        found = reader.at(self.indices[-1]) or reader.latest
        return found if isinstance(found, Map) else None

    def _finish_fold(self, name: str, writer: RecordingWriter | None, view: View, recorded: bool) -> None:
        plugin = self.graph.stages[name].plugin
        state = self._fold_states.pop(name) if name in self._fold_states else plugin.start()
        began = time.perf_counter()
        value = plugin.finish(state, self.result.map)
        self.timing.add_finish(name, 1e3 * (time.perf_counter() - began))
        self.result.folds[name] = value
        if writer is not None:
            if recorded:
                writer.write(name, value)
            writer.show(view, value, value.stamp_ns)

    def _explain(self, failure: NodeFailure, writer: RecordingWriter | None) -> TrihedronError:
        """The failure as one line: a user's mistake as it is, anything else with stage, frame and the command that repeats only that."""
        error = failure.__cause__
        if isinstance(error, TrihedronError):
            return error
        index, stage = [*self.indices[failure.position : failure.position + 1], failure.position][0], failure.node
        cure = ""
        if writer is not None:
            cure = f"repeat only that with: trihedron run replay={writer.path} only=[{stage}] dataset.frames={index}:{index + 1}"
        plugin = type(self.graph.stages[stage].plugin).__name__ if stage in self.graph.stages else "recording"
        return StageError(f"{stage} ({plugin}), frame {index}", f"{type(error).__name__}: {error}", cure)


def _asked_after(graph: Graph, name: str) -> int:
    """How many frames after it a stage's value is first asked for, 0 where that is at once or at no fixed time."""
    delays = [wire.delay for stage in graph.stages.values() for wire in stage.inputs.values() if wire.topic == name]
    return max(0, min(delays, default=0))
