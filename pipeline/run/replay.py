"""The plan of a run: which stages compute, which topics are read from a recording, and the frames.

Without a recording every stage computes. In a replay the stages of `only` compute; a wire from any other stage is read from the file, and where the
file lacks its topic the stage computes after all, back to the frames if need be. A stage that takes `camera` reads that of the topic `frames`, unless
the data set is computed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from trihedron.pipeline.core.errors import ConfigError, DataError, RecordingError
from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.core.options import frame_range
from trihedron.pipeline.core.slots import CAMERA, SLOTS
from trihedron.pipeline.core.types import Effort, Frame, FrameReference, Value
from trihedron.pipeline.core.wires import Wire
from trihedron.pipeline.record.codec import FRAMES_TOPIC
from trihedron.pipeline.record.reader import Recording, TopicReader
from trihedron.pipeline.run.budget import EFFORT_TOPIC, Budget
from trihedron.pipeline.run.live import is_camera

RECORDED = "recorded:"  # prefix of the node that reads a topic from the file
TOPICS = "topics"  # metadata of a recording: the stages whose values it holds, as JSON


@dataclass(frozen=True)
class Replay:
    """A recording to read from, and the stages to compute again. With `recorded_feedback` their inputs are the recorded values, also those from other
    stages that are computed again and from their own earlier frames; only topics that the recording lacks are read as computed."""

    recording: Recording
    only: tuple[str, ...]
    recorded_feedback: bool = False

    @cached_property
    def topics(self) -> frozenset[str]:
        """The topics that were recorded, those without a single value included: that such a stage returned nothing is recorded too."""
        stated: Any = []
        with suppress(ValueError, RecursionError):
            stated = json.loads(self.recording.metadata.get(TOPICS, "[]"))
        silent = {topic for topic in stated if topic in SLOTS} if isinstance(stated, list) and all(isinstance(t, str) for t in stated) else set()
        return frozenset(self.recording.topics | silent)

    def computed_stages(self, graph: Graph) -> tuple[str, ...]:
        """Return the stages that compute, in order: those chosen, and those whose topics these read and the recording lacks."""
        pending, found = list(self.only), set()
        while pending:
            name = pending.pop()
            if name not in found:
                found.add(name)
                pending += [wire.topic for p, wire in graph.stages[name].inputs.items() if wire.topic not in self.topics and p != CAMERA]
        return tuple(name for name in graph.stages if name in found)

    def reader(self, topic: str) -> Callable[[int], Value | None]:
        """Return a function from frame number to recorded value, to be called with increasing numbers."""
        return TopicReader(self.recording, topic).at if topic in self.recording.topics | {FRAMES_TOPIC} else lambda index: None

    def effort(self, budget: Budget) -> dict[int, int]:
        """Return frame number -> words of the budget that held. Raises ConfigError where the run had no budget, or one of more words."""
        if EFFORT_TOPIC not in self.recording.topics:
            cause = f"{self.recording.path} was recorded without a budget, and a replay takes the decisions of its run"
            raise ConfigError("budget_ms", cause, "leave it out")
        levels = {value.index: value.level for value in self.recording.values(EFFORT_TOPIC) if isinstance(value, Effort)}
        if (most := max(levels.values(), default=0)) > len(budget.words):
            raise ConfigError("budget_order", f"has {len(budget.words)} words, and up to {most} held in the recorded run", "leave it out")
        return levels

    def references(self, frames: str) -> dict[int, FrameReference]:
        """Return frame number -> reference for the recorded frames in a range. Raises RecordingError when there is none."""
        wanted = frame_range(frames)
        found = {value.index: value for value in self.recording.references if value.index in wanted}
        if not found:
            raise RecordingError(str(self.recording.path), f"has none of the frames '{frames or ':'}'", "give another dataset.frames")
        return found


@dataclass(frozen=True)
class Plan:
    """The stages of a graph that compute, in order, and the numbers of the frames, with the stamps and the rate that are known before reading them.
    `requested` are the numbers of the data set's frames; of these a replay has those that were recorded."""

    graph: Graph
    replay: Replay | None
    computed: tuple[str, ...]
    requested: range
    indices: Sequence[int]
    stamps_ns: Mapping[int, int]
    fps: float | None = None

    def at_rate(self, frame: Frame) -> Frame:
        """Return a frame whose camera has the rate of the run: that of the recording, else that of the data set, over the stride."""
        return at_rate(frame, frame.camera.fps / self.requested.step if self.fps is None else self.fps)

    def source(self, parameter: str, wire: Wire) -> Wire:
        """Return the wire of a computed stage's input as nodes have it: from another computed stage, or from the file."""
        topic = FRAMES_TOPIC if parameter == CAMERA else wire.topic
        recorded = self.replay is not None and self.replay.recorded_feedback and wire.topic in self.replay.topics
        return Wire(RECORDED + topic, wire.delay) if wire.topic not in self.computed or recorded else wire


def at_rate(frame: Frame, fps: float) -> Frame:
    """Return a frame whose camera has a rate, the same where it has."""
    return frame if frame.camera.fps == fps else replace(frame, camera=replace(frame.camera, fps=fps))


def plan_run(graph: Graph, replay: Replay | None, frames: str) -> Plan:
    """Plan a run over a range of frames (see `frame_range`). Raises RecordingError where the recording cannot give what the stages need."""
    requested = frame_range(frames)
    if replay is None:
        return Plan(graph, None, tuple(graph.stages), requested, requested[: len(graph.stages["dataset"].plugin)], {})
    computed = replay.computed_stages(graph)
    if "dataset" in computed and "dataset" not in replay.only:
        _check_images(graph, replay)
    references = replay.references(frames)
    stamps = {index: reference.stamp_ns for index, reference in references.items()}
    return Plan(graph, replay, computed, requested, list(references), stamps, next(iter(references.values())).camera.fps)


def _check_images(graph: Graph, replay: Replay) -> None:
    """Raise RecordingError when a replay needs the images, the recording does not embed them, and the data set cannot be opened."""
    needing = " and ".join(replay.only)
    if is_camera(graph.stages["dataset"].plugin):
        raise RecordingError(str(replay.recording.path), f"does not embed the images that {needing} must see", "record with record.frames=true")
    try:
        len(graph.stages["dataset"].plugin)
    except DataError as error:
        cause = f"does not embed the frames that {needing} must see, and the data set is gone ({error.place}: {error.cause})"
        raise RecordingError(str(replay.recording.path), cause, "give its new place as dataset.path=FOLDER") from error
