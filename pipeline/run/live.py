"""Live sources: frames that come in real time, and frame dropping.

A live source delivers frames at its own rate. A run takes the newest frame that it has not seen; earlier ones are dropped, never queued, so that the
latency of a pose is that of one frame. The recording holds the frames that were taken (topic `frames`), so that a replay goes through the same ones.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from trihedron.pipeline.core.errors import DataError


class Pace(Enum):
    """The pace of a run: frames at once, at the camera's rate, or at its rate with frame dropping."""

    none = "none"
    real_time = "real_time"
    live = "live"


@dataclass(frozen=True)
class Arrival:
    """A frame that has arrived: its number and time (time.perf_counter)."""

    number: int
    at_s: float


class Camera(Protocol):
    """A live source of frames; a data set that has these methods too is one.

    `start` begins anew with frame 0. `wait(after)` waits for a frame later than `after` and returns the newest, or None when no more will come; the
    data set's `__call__` then gives that frame. `stop` ends it."""

    def start(self) -> None: ...

    def wait(self, after: int) -> Arrival | None: ...

    def stop(self) -> None: ...


class Playback:
    """Any data set as a live source: frame k of `count` comes k / fps after the first was requested. With `drop` False every frame is delivered in
    turn, none before its time."""

    def __init__(self, count: int, fps: float, drop: bool = True) -> None:
        self._count, self._period_s, self._drop = count, 1.0 / fps, drop
        self._began: float | None = None

    def start(self) -> None:
        """Restart: the next frame requested is the first."""
        self._began = None

    def wait(self, after: int) -> Arrival | None:
        """Return the newest frame that has come, at least the one after `after`."""
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
        """Do nothing: no thread runs."""


class Feed:
    """The frames that a run takes from a live source, in order: `numbers` in the data set of those taken so far, and the time each came. `requested`
    are the numbers of all that may come."""

    def __init__(self, camera: Camera, requested: range) -> None:
        self._camera, self._requested = camera, requested
        self._latest = -1  # of those that came, counted from 0
        self.numbers: list[int] = []
        self.came_s: list[float] = []

    def start(self) -> None:
        """Begin with frame 0."""
        self._camera.start()
        self._latest = -1
        self.numbers.clear()
        self.came_s.clear()

    def take(self) -> int | None:
        """Wait for the next frame and return its number; None when no more will come."""
        arrival = self._camera.wait(self._latest)
        if arrival is None:
            return None
        self._latest = arrival.number
        self.numbers.append(self._requested[arrival.number])
        self.came_s.append(arrival.at_s)
        return self.numbers[-1]

    def stop(self) -> None:
        """Stop the source."""
        self._camera.stop()

    def summary(self, latency_ms: dict[str, float]) -> dict[str, Any]:
        """Return the numbers of frames that came during the run, were taken and were dropped, and the latency of their poses."""
        came = self._latest + 1
        return {"came": came, "taken": len(self.numbers), "dropped": came - len(self.numbers), "latency_ms": latency_ms}


def is_camera(dataset: Any) -> bool:
    """Return True for a data set that is a live source."""
    return hasattr(dataset, "wait")


def shows_once(dataset: Any) -> bool:
    """Return True for a live source whose frames are always embedded in a recording, as it shows none twice; `embedded = False` declares one whose
    frames are not."""
    return is_camera(dataset) and bool(getattr(dataset, "embedded", True))


def feed_of(dataset: Any, pace: Pace, requested: range) -> Feed | None:
    """Return the feed of a live source, or of the `requested` frames of a data set, played as one; None where frames can be read at any time. Raises
    DataError where no frame can be read, which has the rate."""
    if is_camera(dataset):
        return Feed(dataset, requested)
    if pace is Pace.none:
        return None
    first = next((frame for frame in map(dataset, range(len(dataset))) if frame is not None), None)
    if first is None:
        raise DataError("dataset", "none of its frames can be read", "see the warnings above")
    return Feed(Playback(len(dataset), first.camera.fps / requested.step, pace is Pace.live), requested)
