"""Frames that a Python program pushes: the data set behind `trihedron.Slam`."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Trajectory

ENDLESS = 1 << 30


class Arrival(NamedTuple):
    """Number of a frame, and the time at which it was pushed (time.perf_counter)."""

    number: int
    at_s: float


class FrameQueue:
    """Frames in the order in which they were pushed; none is dropped. Any thread may push, any other take."""

    def __init__(self) -> None:
        self._frames: dict[int, tuple[Frame, float]] = {}
        self._changed = threading.Condition()
        self._open = True
        self._pushed = 0

    def push(self, frame: Frame) -> None:
        """Append the next frame."""
        with self._changed:
            self._frames[self._pushed] = frame, time.perf_counter()
            self._pushed += 1
            self._changed.notify_all()

    def close(self) -> None:
        """End the sequence after the frames pushed so far."""
        with self._changed:
            self._open = False
            self._changed.notify_all()

    def wait(self, number: int) -> float | None:
        """Wait for frame `number` and return when it was pushed; None at the end of the sequence."""
        with self._changed:
            self._changed.wait_for(lambda: number < self._pushed or not self._open)
            return self._frames[number][1] if number < self._pushed else None

    def take(self, number: int) -> Frame:
        """Remove a frame and return it."""
        with self._changed:
            return self._frames.pop(number)[0]


@register("dataset", "pushed")
@dataclass(frozen=True)
class Pushed:
    """Frames from a Python program, pushed through `trihedron.Slam`; none is dropped. They are embedded in the recording with `record.frames=true`
    only."""

    embedded: ClassVar[bool] = False

    def __len__(self) -> int:
        return ENDLESS

    def start(self) -> None:
        """Begin with frame 0. Raises DataError where no program pushes frames, as on the command line."""
        if "queue" not in vars(self):
            raise DataError("dataset=pushed", "its frames come from a Python program", "push them with trihedron.Slam, or choose another data set")

    def wait(self, after: int) -> Arrival | None:
        """Wait for the frame after `after`; None after the last one."""
        at_s = self.queue.wait(after + 1)
        return Arrival(after + 1, at_s) if at_s is not None else None

    def stop(self) -> None:
        """Accept no more frames."""
        self.queue.close()

    def __call__(self, index: int) -> Frame | None:
        return self.queue.take(index)

    def truth(self) -> Trajectory | None:
        """Return None: a program that has the true poses compares them itself."""
        return None

    @cached_property
    def queue(self) -> FrameQueue:
        """The frames that wait to be taken."""
        return FrameQueue()
