"""The recorder of a run: writes values, views and times, frame by frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trihedron.pipeline.core.graph import Graph
from trihedron.pipeline.core.types import Effort, Frame, FrameReference, Trajectory, Value
from trihedron.pipeline.record.codec import FRAMES_TOPIC
from trihedron.pipeline.record.foxglove import TopicView
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.accounting import FrameTimes
from trihedron.pipeline.run.budget import EFFORT_TOPIC
from trihedron.pipeline.run.replay import Plan
from trihedron.pipeline.run.timing import resident_mb


class Recorder:
    """A sink that writes the values of the chosen topics, what viewers show, the references to the frames and the times."""

    def __init__(self, writer: RecordingWriter, plan: Plan, topics: frozenset[str], embed_frames: bool, truth: Trajectory | None) -> None:
        self._writer, self._topics = writer, topics if embed_frames else topics - {"dataset"}
        self._computed, self._view = plan.computed, TopicView(truth)
        self._delays = {name: first_read_delay(plan.graph, name) for name in plan.computed}
        self._reference = plan.replay.reader(FRAMES_TOPIC) if plan.replay is not None else None

    def frame(self, index: int, stamp_ns: int, values: Mapping[str, Any], times: FrameTimes) -> None:
        """Write one frame."""
        if (reference := self._reference_of(index, values.get("dataset"))) is not None:
            self._writer.write(FRAMES_TOPIC, reference)
        if isinstance(effort := values.get(EFFORT_TOPIC), Effort):
            self._writer.write(EFFORT_TOPIC, effort)
        for name in self._computed:
            if isinstance(value := values.get(name), Value):
                if name in self._topics:
                    self._writer.write(name, value, self._delays[name])
                self._writer.show(self._view, value, stamp_ns)
        self._writer.write_timing(index, stamp_ns, times.latency_ms or 0.0, times.calls_ms, resident_mb())

    def _reference_of(self, index: int, frame: Any) -> Value | None:
        if isinstance(frame, Frame):
            return FrameReference(frame.index, frame.stamp_ns, frame.camera)
        return self._reference(index) if self._reference is not None else None

    def preview(self, name: str, value: Value) -> None:
        """Show viewers what a fold has so far."""
        self._writer.show(self._view, value, value.stamp_ns)

    def fold(self, name: str, value: Value) -> None:
        """Write the result of a fold."""
        if name in self._topics:
            self._writer.write(name, value)
        self._writer.show(self._view, value, value.stamp_ns)


def first_read_delay(graph: Graph, name: str) -> int:
    """Return the number of frames after which a stage's value is first read, 0 where that is at once or at no fixed time."""
    delays = [wire.delay for stage in graph.stages.values() for wire in stage.inputs.values() if wire.topic == name]
    return max(0, min(delays, default=0))
