"""The state of a run: the values that its delayed wires hold."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from trihedron.pipeline.core.graph import Stage
from trihedron.pipeline.core.types import Value
from trihedron.pipeline.core.wires import PREVIOUS
from trihedron.pipeline.record.reader import Recording, TopicReader


@dataclass(frozen=True)
class DelayLines:
    """`held`: topic -> the latest value before the first frame, for `@prev`; `recent`: topic -> position (-1: one frame before the first) -> value,
    for `@k`, which counts the frames of the run whatever their numbers."""

    held: Mapping[str, Value] = field(default_factory=dict)
    recent: Mapping[str, Mapping[int, Value]] = field(default_factory=dict)

    def merge_with_prefix(self, other: DelayLines, prefix: str) -> DelayLines:
        """Return these with the topics of others, and all of them once more under names with a prefix."""
        held, recent = {**self.held, **other.held}, {**self.recent, **other.recent}
        more = {prefix + topic: value for topic, value in held.items()}
        return DelayLines({**held, **more}, {**recent, **{prefix + topic: values for topic, values in recent.items()}})


def max_delays(stages: Iterable[Stage]) -> dict[str, int]:
    """Return topic -> the largest delay, in frames, with which a delayed wire reads it; 1 where only `@prev` does."""
    found: dict[str, int] = {}
    for stage in stages:
        for wire in stage.inputs.values():
            if wire.delay:
                found[wire.topic] = max(found.get(wire.topic, 1), 1 if wire.delay == PREVIOUS else wire.delay)
    return found


class StateBuffer:
    """Holds, after each frame, the values that delayed wires can still read: all that another run needs to continue with the next frame."""

    def __init__(self, max_delay: Mapping[str, int], before: DelayLines, first: int) -> None:
        """`before` are the values that a run beginning with frame `first` starts from. `values`: topic -> position -> value, in order."""
        self._max_delay, self._position = max_delay, 0
        self.values: dict[str, dict[int, Value]] = {topic: dict(before.recent.get(topic, {})) for topic in max_delay}
        for topic, delay in max_delay.items():
            if (held := before.held.get(topic)) is not None and not self.values[topic]:
                self.values[topic][-delay] = held  # only `@prev` reads it, until the next value
            self.values[topic] = dict(sorted(self.values[topic].items()))
        self.frame = first - 1  # number of the last frame

    def append(self, index: int, values: Mapping[str, Any]) -> None:
        """Add the values of the next frame and drop those that no wire can read any more."""
        self.frame = index
        for topic, delay in self._max_delay.items():
            line = self.values[topic]
            if isinstance(value := values.get(topic), Value):
                line[self._position] = value
            while len(line) > 1 and (oldest := next(iter(line))) <= self._position - delay:
                del line[oldest]
        self._position += 1


def recorded_delay_lines(recording: Recording, max_delay: Mapping[str, int], first: int) -> DelayLines:
    """Read the values that the wires of a run beginning with frame `first` would hold of a recording's topics, had it run from the start."""
    held: dict[str, Value] = {}
    recent: dict[str, dict[int, Value]] = {}
    frames = sorted({value.index for value in recording.references if value.index < first})  # a live run did not take them all
    for topic in sorted(set(max_delay) & recording.topics):
        reader = TopicReader(recording, topic)
        recent[topic] = {}
        for ago in range(min(max_delay[topic], len(frames)), 0, -1):
            if (value := reader.at(frames[-ago])) is not None:
                recent[topic][-ago] = value
        reader.at(first)
        if (latest := recent[topic][max(recent[topic])] if recent[topic] else reader.latest) is not None:
            held[topic] = latest
    return DelayLines(held, recent)
