"""A sink that shows a run in rerun while it goes on."""

from __future__ import annotations

import queue
import threading
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from trihedron.pipeline.core.types import Frame, Keypoints, ManhattanFrame, Map, Planes, Pose, Segments, Surface, Value
from trihedron.pipeline.record.rerun_view import at, begin, show_times, show_value
from trihedron.pipeline.run.accounting import FrameTimes

WAITING = 8  # frames that wait for the viewer; while it is slower, further ones are not shown
CLOSING_S = 1.0  # that closing waits for the viewer, twice
SPARSE_NS = 200_000_000  # between two values shown of the types that take long to show
PERIODS_NS: dict[type[Value], int] = {
    Pose: 0,
    Keypoints: 0,
    Segments: SPARSE_NS,
    ManhattanFrame: SPARSE_NS,
    Frame: SPARSE_NS,
    Planes: SPARSE_NS,
    Map: 1_000_000_000,
    Surface: 0,
}


class RerunSink:
    """Logs values to a rerun stream in a thread of its own; a viewer that is slow, or closed, does not slow the run."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._last_ns: dict[type[Value], int] = {}
        self._queue: queue.Queue[tuple[int, int, list[Value], Mapping[str, float]] | None] = queue.Queue()
        begin(stream)
        self._thread = threading.Thread(target=self._work, name="rerun", daemon=True)
        self._thread.start()

    def frame(self, index: int, stamp_ns: int, values: Mapping[str, Any], times: FrameTimes) -> None:
        """Show a frame, unless too many wait already."""
        if self._queue.qsize() < WAITING:
            shown = [value for value in values.values() if isinstance(value, Value) and self._due(type(value), stamp_ns)]
            self._queue.put((index, stamp_ns, shown, dict(times.calls_ms)))

    def preview(self, name: str, value: Value) -> None:
        """Show what a fold has so far."""
        self._queue.put((value.index, value.stamp_ns, [value], {}))

    def fold(self, name: str, value: Value) -> None:
        """Show the result of a fold."""
        self._queue.put((value.index, value.stamp_ns, [value], {}))

    def close(self) -> None:
        """Show what waits, and end; a viewer that does not go on is given up."""
        self._queue.put(None)
        self._thread.join(CLOSING_S)
        with suppress(RuntimeError):  # the viewer was closed, or does not go on
            self._stream.flush(timeout_sec=CLOSING_S)

    def _due(self, kind: type[Value], stamp_ns: int) -> bool:
        period, last = PERIODS_NS.get(kind), self._last_ns.get(kind)
        if period is None or (last is not None and 0 <= stamp_ns - last < period):
            return False
        self._last_ns[kind] = stamp_ns
        return True

    def _work(self) -> None:
        while (item := self._queue.get()) is not None:
            index, stamp_ns, values, calls_ms = item
            at(self._stream, index, stamp_ns)
            for value in values:
                show_value(self._stream, value)
            show_times(self._stream, calls_ms)
