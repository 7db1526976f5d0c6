"""Runs a graph over a data set or a recording, frame by frame: plans, executes, keeps the books and records.

The plan is in `replay`, the order of calls on several threads in `scheduler`, the books in `accounting`, the values of delayed wires in `state`.
"""

from __future__ import annotations

import logging
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import StageError, TrihedronError
from trihedron.pipeline.core.graph import Graph, Stage
from trihedron.pipeline.core.registry import check_value
from trihedron.pipeline.core.slots import CAMERA, RNG
from trihedron.pipeline.core.types import Effort, Frame, Map, Pose, Trajectory, Value
from trihedron.pipeline.core.value_checks import check_together
from trihedron.pipeline.core.wires import Wire
from trihedron.pipeline.record.reader import TopicReader
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.accounting import Accounting
from trihedron.pipeline.run.budget import EFFORT_TOPIC, Budget, BudgetedStages, Decisions, Governor, RecordedDecisions
from trihedron.pipeline.run.frame_validation import FrameValidation
from trihedron.pipeline.run.interrupts import Interrupts
from trihedron.pipeline.run.live import Pace, feed_of
from trihedron.pipeline.run.memory import exhaustion, malloc_trim
from trihedron.pipeline.run.node import Node, NodeFailure, NoMoreFrames
from trihedron.pipeline.run.recorder import Recorder
from trihedron.pipeline.run.replay import RECORDED, Replay, plan_run
from trihedron.pipeline.run.scheduler import Scheduler, single_threaded_libraries
from trihedron.pipeline.run.sinks import Sink
from trihedron.pipeline.run.state import DelayLines, StateBuffer, max_delays, recorded_delay_lines
from trihedron.pipeline.run.time_offset_check import TimeOffsetCheck

log = logging.getLogger("trihedron")
TRIM_EVERY = 1000  # frames; it takes some 10 ms
NodeCall = Callable[[int, Mapping[str, Any]], Any]
FRAME_TAKEN = "dataset:"  # input of every stage of a live run: which frame it is must be known first


@dataclass(frozen=True)
class Step:
    """One finished frame, as handed to the caller of a run (progress, tests)."""

    position: int
    count: int
    index: int
    values: Mapping[str, Value | None]


class Runner:
    """One run of a graph. `steps` does the work, frame by frame; `result` and `timing` hold the outcome."""

    def __init__(
        self,
        graph: Graph,
        seed: int = 0,
        threads: int = 2,
        replay: Replay | None = None,
        frames: str = "",
        initial: Callable[[int], DelayLines] | None = None,
        pace: Pace = Pace.none,
        on_value: Callable[[int, str, Value | None], None] | None = None,
        preview_period: int = 0,
        budget: Budget | None = None,
    ) -> None:
        """`initial` returns the values of delayed wires before the frame of a given number, `pace` is when frames may be read. `on_value` is called
        with position, stage and value as soon as a stage is done with a frame, from any thread. Every
        `preview_period` frames sinks get what a fold has so far, if its plugin has a method `preview(state)`; 0: never. Some stages
        are other ones at frames whose predecessors exceed the `budget`."""
        self._on_value = on_value
        self.graph, self.seed, self.threads, self.replay = graph, seed, threads, replay
        self.plan = plan_run(graph, replay, frames)
        self.feed = feed_of(graph.stages["dataset"].plugin, pace, self.plan.requested) if replay is None else None
        self.computed, self.indices, self.count = self.plan.computed, self.plan.indices, len(self.plan.indices)  # `count` frames, at most
        delays = max_delays(graph.stages[name] for name in self.computed)
        self.initial = initial(self.indices[0]) if initial is not None else DelayLines()
        if replay is not None:
            self.initial = self.initial.merge_with_prefix(recorded_delay_lines(replay.recording, delays, self.indices[0]), RECORDED)
        self.state = StateBuffer(delays, self.initial, self.indices[0])
        loaded = self.initial.held.get("map")
        self.accounts = Accounting(self.plan.stamps_ns, self.plan.fps, loaded if isinstance(loaded, Map) else None)
        self.result, self.timing = self.accounts.result, self.accounts.timing
        self.validation = FrameValidation(self.plan.stamps_ns, self.count if self.feed is None else 0)
        self._time_offset = TimeOffsetCheck()
        self._sources = str(replay.recording.path) if replay is not None else "load_map" if self.initial.held else ""  # files of inputs
        self.budgeted = BudgetedStages(budget, self._decisions(budget)) if budget is not None else None
        self._fold_states: dict[str, Any] = {}
        self._preview_period = preview_period
        self._previews: deque[tuple[str, Value]] = deque()
        self.sinks: tuple[Sink, ...] = ()

    def _decisions(self, budget: Budget) -> Decisions:
        return Governor(budget) if self.replay is None else RecordedDecisions(self.replay.effort(budget), self.indices)

    def steps(
        self,
        writer: RecordingWriter | None,
        topics: frozenset[str],
        embed_frames: bool = False,
        truth: Trajectory | None = None,
        sinks: Sequence[Sink] = (),
    ) -> Iterator[Step]:
        """Run, yielding each finished frame; values of `topics` go to the writer, with what viewers show, errors by `truth` too, and all values to
        the sinks. Raises TrihedronError (StageError names stage and frame)."""
        scheduler = Scheduler(self.nodes(), self.threads, self.threads, self.initial.held, self.recent())
        self.sinks = (*([Recorder(writer, self.plan, topics, embed_frames, truth)] if writer is not None else []), *sinks)
        self.timing.begin()
        try:
            with single_threaded_libraries(), self._feeding(), Interrupts() as interrupts:
                for position, values in scheduler.run(self.count):
                    with interrupts.defer():
                        self.take(position, values)
                    yield Step(position, self.count, self.indices[position], values)
                self.finish()
        except NodeFailure as failure:
            raise self.explain(failure, writer) from failure.__cause__

    def recent(self) -> dict[str, dict[int, Value]]:
        """Return the values before the first frame that `@k` wires read: topic -> position (-1: one frame before) -> value."""
        return {topic: dict(values) for topic, values in self.initial.recent.items()}

    @contextmanager
    def _feeding(self) -> Iterator[None]:
        """Take frames from a live source, which numbers them as they are taken."""
        if self.feed is None:
            yield
            return
        self.feed.start()
        self.indices = self.feed.numbers
        try:
            yield
        finally:
            self.feed.stop()

    def take(self, position: int, values: Mapping[str, Any]) -> None:
        """Account for a finished frame and record it."""
        index, accounts = self.indices[position], self.accounts
        self.state.append(index, values)
        if accounts.take(position, index, values, self.count, position in self.validation.left_out):
            self._judge_time_offset(values.get("dataset"), values.get("pose"))
            if self.budgeted is not None:
                level = self.budgeted.take(position, index, accounts.times[position].latency_ms or 0.0)
                values = {**values, EFFORT_TOPIC: Effort(index, accounts.stamps_ns[index], level)}
            for sink in self.sinks:
                sink.frame(index, accounts.stamps_ns[index], values, accounts.times[position])
            while self._previews:
                name, value = self._previews.popleft()
                for sink in self.sinks:
                    sink.preview(name, value)
        accounts.forget(position, index)
        if (position + 1) % TRIM_EVERY == 0:
            malloc_trim()

    def _judge_time_offset(self, frame: Any, pose: Any) -> None:
        if isinstance(frame, Frame) and isinstance(pose, Pose) and (found := self._time_offset(frame, pose)):
            log.warning("%s", found)

    def nodes(self) -> list[Node]:
        """Return the nodes of the stages that compute, behind those of the topics that they read from a file, in topological order."""
        readers: dict[str, Node] = {}
        stages = [self._stage_node(self.graph.stages[name], readers) for name in self.computed]
        return [*readers.values(), *stages]

    def _stage_node(self, stage: Stage, readers: dict[str, Node]) -> Node:
        """Make the node of a stage, and those of the topics it reads from the file."""
        inputs = {parameter: self.plan.source(parameter, wire) for parameter, wire in stage.inputs.items()}
        for wire in inputs.values():
            if wire.topic.startswith(RECORDED) and wire.topic not in readers:
                readers[wire.topic] = self._reader_node(wire.topic)
        if stage.name == "dataset":
            read = self._report_value(stage.name, lambda position, _: self._read_frame(stage, position))
            return Node(stage.name, read, inputs, ordered=True, waits=self.feed is not None)
        if self.feed is not None:
            inputs[FRAME_TAKEN] = Wire("dataset")
        return Node(stage.name, self._report_value(stage.name, partial(self._call, stage)), inputs, stage.fold)

    def _report_value(self, stage: str, call: NodeCall) -> NodeCall:
        """Wrap the call of a stage so that its value is handed to `on_value`."""
        if (report := self._on_value) is None:
            return call

        def call_and_report(position: int, values: Mapping[str, Any]) -> Any:
            value = call(position, values)
            report(position, stage, value)
            return value

        return call_and_report

    def _reader_node(self, name: str) -> Node:
        assert self.replay is not None
        read = self.replay.reader(name.removeprefix(RECORDED))
        return Node(name, lambda position, _: read(self.indices[position]), {}, ordered=True)

    def _read_frame(self, stage: Stage, position: int) -> Any:
        """Return the frame at a position, validated, or None."""

        def read(at: int) -> Any:
            if self.feed is not None and self.feed.take() is None:
                raise NoMoreFrames
            began = time.perf_counter()
            frame = stage.plugin(index=self.plan.requested.index(self.indices[at]))
            ended = time.perf_counter()
            self.accounts.frame_read(at, began, ended, ended if self.feed is None else self.feed.came_s[at])
            if frame is None:
                return None
            check_value(stage.name, frame, self.indices[at])
            return self.plan.at_rate(frame)

        return self.validation(position, read, lambda: self.indices[position])

    def _call(self, stage: Stage, position: int, values: Mapping[str, Any]) -> Value | None:
        """Skip, seed, time and check one call."""
        if self.budgeted is not None and (changed := self.budgeted.stage(stage, position)) is not stage:
            stage, values = changed, {parameter: values[parameter] for parameter in changed.inputs}
        if any(values[parameter] is None for parameter in stage.required):
            return None
        arguments = {**dict.fromkeys(stage.absent), **values}
        arguments.pop(FRAME_TAKEN, None)
        if self._sources:
            self._check_inputs(stage, arguments)
        if CAMERA in arguments:
            arguments[CAMERA] = arguments[CAMERA].camera  # of a frame, or of the recording's reference to it
        if stage.wants_rng:
            arguments[RNG] = np.random.default_rng([self.seed, self.indices[position], zlib.crc32(stage.name.encode())])
        began = time.perf_counter()
        value = None
        if stage.fold:
            state = self._fold_states[stage.name] if stage.name in self._fold_states else stage.plugin.start()
            self._fold_states[stage.name] = state = stage.plugin.add(state, **arguments)
            if self._preview_period and (position + 1) % self._preview_period == 0 and hasattr(stage.plugin, "preview"):
                self._previews.append((stage.name, stage.plugin.preview(state)))
        else:
            value = stage.plugin(**arguments)
        self.accounts.stage_called(position, stage.name, began, time.perf_counter())
        if value is not None:
            check_value(stage.name, value, self.indices[position])
        return value

    def _check_inputs(self, stage: Stage, arguments: Mapping[str, Any]) -> None:
        """Check inputs of a call that come from a file: of a replay those that are read, of a loaded map those from before the first frame."""
        topics = {parameter: wire.topic for parameter, wire in stage.inputs.items()}
        computed = set(self.computed)
        for parameter, wire in stage.inputs.items():
            value = arguments.get(parameter)
            early = bool(wire.delay) and isinstance(value, Value) and value.index < self.indices[0]
            if early or self.plan.source(parameter, wire).topic.startswith(RECORDED):
                computed.discard(wire.topic)
        if not computed.issuperset(topics.values()):
            check_together(arguments, self._sources, topics, computed)

    def finish(self) -> None:
        """Take the map of a recording where none was computed and poses or folds need it, and finish the folds; after the last frame. Raises
        DataError where no frame showed anything."""
        self.validation.check_begun()
        if "map" not in self.computed and any(name == "pose" or self.graph.stages[name].fold for name in self.computed):
            self.result.map = self._recorded_map()
        for name in self.computed:
            if self.graph.stages[name].fold:
                self._finish_fold(name)

    def _finish_fold(self, name: str) -> None:
        plugin = self.graph.stages[name].plugin
        state = self._fold_states.pop(name) if name in self._fold_states else plugin.start()
        began = time.perf_counter()
        value = plugin.finish(state, self.result.map)
        self.timing.add_finish(name, 1e3 * (time.perf_counter() - began))
        self.result.folds[name] = value
        for sink in self.sinks:
            sink.fold(name, value)

    def fold_state(self, name: str) -> Any:
        """Return the state of a fold so far, that of no frame before its first; to be read while its stage is not called."""
        return self._fold_states[name] if name in self._fold_states else self.graph.stages[name].plugin.start()

    def _recorded_map(self) -> Map | None:
        """Return the map after the last frame, where it was read rather than computed."""
        if self.replay is None or "map" not in self.replay.recording.topics:
            return self.result.map
        reader = TopicReader(self.replay.recording, "map")
        found = reader.at(self.indices[-1]) or reader.latest
        return found if isinstance(found, Map) else None

    def explain(self, failure: NodeFailure, writer: RecordingWriter | None) -> TrihedronError:
        """Return the failure as one line: a user's mistake as it is, anything else with stage, frame and the command that repeats only that."""
        error = failure.__cause__
        if isinstance(error, TrihedronError):
            return error
        if error is not None and (exhausted := exhaustion(error)) is not None:
            return exhausted
        index, stage = [*self.indices[failure.position : failure.position + 1], failure.position][0], failure.node
        cure = ""
        if writer is not None and writer.path is not None:
            cure = f"repeat only that with: trihedron run replay={writer.path} 'only=[{stage}]' dataset.frames={index}:{index + 1}"
        plugin = type(self.graph.stages[stage].plugin).__name__ if stage in self.graph.stages else "recording"
        return StageError(f"{stage} ({plugin}), frame {index}", f"{type(error).__name__}: {error}", cure)
