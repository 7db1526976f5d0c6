"""Frames that come in real time: which of them a run takes, and which it misses.

A camera delivers frames when it wants to. A run asks it for the newest frame it has not seen; those that came and went meanwhile are dropped,
never queued, so that a pose is as late as one frame takes and no later. Which frames were taken stands in the recording (topic `frames`), so that
a replay goes through the same ones.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from trihedron.pipeline.core.errors import DataError


class Pace(Enum):
    """When frames may be asked for: at once, at the camera's rate, or at its rate with those dropped for which the run comes too late."""

    none = "none"
    real_time = "real_time"
    live = "live"


@dataclass(frozen=True)
class Arrival:
    """A frame that is there: its number, and when it came (time.perf_counter)."""

    number: int
    at_s: float


class Camera(Protocol):
    """What delivers frames in real time; a data set that has these methods too is a camera by itself.

    `start` begins anew with frame 0. `wait(after)` waits for a frame later than `after` and returns the newest, or None when no more will come; the
    data set's `__call__` then gives that frame. `stop` ends it."""

    def start(self) -> None: ...

    def wait(self, after: int) -> Arrival | None: ...

    def stop(self) -> None: ...


class Playback:
    """Any data set as a camera: frame k of `count` comes k / fps after the first was asked for. With `drop` False every frame is given in turn,
    none before its time."""

    def __init__(self, count: int, fps: float, drop: bool = True) -> None:
        self._count, self._period_s, self._drop = count, 1.0 / fps, drop
        self._began: float | None = None

    def start(self) -> None:
        """The next frame asked for is the first."""
        self._began = None

    def wait(self, after: int) -> Arrival | None:
        """The newest frame that has come, at least the one after `after`."""
        now = time.perf_counter()
        if self._began is None:
            self._began = now
        here = int((now - self._began) / self._period_s) if self._drop else 0
        number = min(max(after + 1, here), self._count - 1)
        if number <= after:
            return None
        at_s = self._began + number * self._period_s
        time.sleep(max(0.0, at_s - now))
        return Arrival(number, at_s)

    def stop(self) -> None:
        """Nothing runs."""


class Feed:
    """What a run takes of a camera, in order: `numbers` of the frames taken so far (from 0), and when each came."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.numbers: list[int] = []
        self.came_s: list[float] = []

    def start(self) -> None:
        """Begin with frame 0."""
        self._camera.start()
        self.numbers.clear()
        self.came_s.clear()

    def take(self) -> int | None:
        """Wait for the next frame and return its number; None when no more will come."""
        arrival = self._camera.wait(self.numbers[-1] if self.numbers else -1)
        if arrival is None:
            return None
        self.numbers.append(arrival.number)
        self.came_s.append(arrival.at_s)
        return arrival.number

    def stop(self) -> None:
        """No more frames are wanted."""
        self._camera.stop()

    def summary(self, latency_ms: dict[str, float]) -> dict[str, Any]:
        """How many frames came while the run went on, how many were taken and dropped, and how late their poses were."""
        came = self.numbers[-1] + 1 if self.numbers else 0
        return {"came": came, "taken": len(self.numbers), "dropped": came - len(self.numbers), "latency_ms": latency_ms}


def is_camera(dataset: Any) -> bool:
    """Whether a data set delivers frames by itself, when it wants to."""
    return hasattr(dataset, "wait")


def feed_of(dataset: Any, pace: Pace) -> Feed | None:
    """What a run takes frames from: a camera, a data set played as one, or None where frames are there at any time. Raises DataError where no frame
    says how many there are a second."""
    if is_camera(dataset):
        return Feed(dataset)
    if pace is Pace.none:
        return None
    first = next((frame for frame in map(dataset, range(len(dataset))) if frame is not None), None)
    if first is None:
        raise DataError("dataset", "none of its frames can be read", "see the warnings above")
    return Feed(Playback(len(dataset), first.camera.fps, pace is Pace.live))
