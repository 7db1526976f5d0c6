"""Sinks: receivers of what a run produces, frame by frame. A recording with Foxglove's server (`recorder`), rerun (`rerun_sink`), and memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from typing import Any, Protocol

from trihedron.pipeline.core.types import Value
from trihedron.pipeline.run.accounting import FrameTimes


class Sink(Protocol):
    """Receiver of a run's frames, in order, from the run's own thread: what takes long is for a thread of the sink's.

    `frame` gets the values by stage (None: nothing), `preview` what a fold has so far, `fold` its result at the end."""

    def frame(self, index: int, stamp_ns: int, values: Mapping[str, Any], times: FrameTimes) -> None: ...

    def preview(self, name: str, value: Value) -> None: ...

    def fold(self, name: str, value: Value) -> None: ...


class MemorySink:
    """Holds the values of some topics of the last `length` frames, and the results of folds."""

    def __init__(self, length: int, topics: Collection[str]) -> None:
        self.frames: deque[tuple[int, dict[str, Value]]] = deque(maxlen=length)
        self.folds: dict[str, Value] = {}
        self._topics = topics

    def frame(self, index: int, stamp_ns: int, values: Mapping[str, Any], times: FrameTimes) -> None:
        """Hold a frame's values, and forget those of the oldest frame."""
        self.frames.append((index, {name: value for name, value in values.items() if name in self._topics and isinstance(value, Value)}))

    def preview(self, name: str, value: Value) -> None:
        """Do nothing: previews are for viewers."""

    def fold(self, name: str, value: Value) -> None:
        """Hold the result of a fold."""
        self.folds[name] = value
