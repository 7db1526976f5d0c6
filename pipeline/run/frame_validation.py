"""What the runner takes from a data set: frames whose images, camera and time stages can rely on. What cannot be used is said and left out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import F32, Frame

log = logging.getLogger("trihedron")
LATE_NS = 1_000_000_000  # a frame that comes this late or later was not late: the clock was set back
SATURATED, CROWDED = 0.02, 3.0  # a limit: share of the image that says it, and times the readings of any other depth
AWAY_S = 0.5  # to a frame that shows surfaces at other distances
JUDGED = 10  # readable frames after which the scale of depth is judged
SAMPLED_PX = 8  # apart are the readings by which scale and limit are judged
NEAR_M, FAR_M = 0.7, 8.0  # half of the readings nearer, or farther: no room of a house is seen like that (a Kinect measures 0.4 to 8 m)


def usable(frame: Frame) -> Frame | None:
    """The frame with readings that are no distance (NaN, infinite, negative) as missing; None where camera and images differ in size."""
    camera, depth, (h, w) = frame.camera, frame.depth_m, frame.depth_m.shape
    if (camera.width, camera.height) != (w, h):
        log.warning("frame %d: its images are %d×%d while the camera is %d×%d; it is skipped", frame.index, w, h, camera.width, camera.height)
        return None
    if depth.min(initial=0.0) >= 0.0 and depth.max(initial=0.0) < np.inf:  # NaN compares false
        return frame
    wrong = ~np.isfinite(depth) | (depth < 0.0)
    log.warning("frame %d: %d depth readings are negative or not finite; they count as missing", frame.index, np.count_nonzero(wrong))
    return replace(frame, depth_m=np.where(wrong, np.float32(0.0), depth))


def without_limit(frame: Frame | None, look: Callable[[float], Any]) -> Frame | None:
    """The frame without the readings that only say the sensor's largest value: much of the image says it, here and in the frame that `look` finds,
    from where a surface would be at another distance."""
    if frame is None or (limit_m := _crowded_maximum(frame.depth_m)) == 0.0:
        return frame
    other = look(frame.camera.fps)
    if not isinstance(other, Frame) or other.index == frame.index or _crowded_maximum(other.depth_m) != limit_m:
        return frame
    saturated = frame.depth_m == limit_m
    count = np.count_nonzero(saturated)
    log.warning("frame %d: %d depth readings say %.3f m and none more, which is a limit; they count as missing", frame.index, count, limit_m)
    return replace(frame, depth_m=np.where(saturated, np.float32(0.0), frame.depth_m))


def _crowded_maximum(depth_m: F32) -> float:
    """The largest depth where many readings, and many more than of any other depth, say exactly that; 0 elsewhere."""
    farthest, sampled = float(depth_m.max(initial=0.0)), depth_m[::SAMPLED_PX, ::SAMPLED_PX]
    if not 0.0 < farthest < np.inf or np.count_nonzero(sampled == farthest) < SATURATED * sampled.size:
        return 0.0
    _, counts = np.unique(depth_m[depth_m > 0.0], return_counts=True)
    return farthest if counts[-1] > CROWDED * counts[:-1].max(initial=0) else 0.0


class Intake:
    """Takes frames in their order. Stamps of frames in `known` are what they were when these were recorded; `count` frames can be read at any time
    (0: a camera's, which comes once). `late` are the positions of frames that were left out because others had come before them."""

    def __init__(self, known: Mapping[int, int], count: int) -> None:
        self._known, self._count = known, count
        self._last_ns: int | None = None
        self._set_back_ns = 0
        self._medians_m: list[float] = []
        self.late: set[int] = set()

    def __call__(self, position: int, read: Callable[[int], Any], index: Callable[[], int]) -> Any:
        """The frame that `read` finds at a position, as stages can rely on it, or None; `index` is its number. What is wrong with the first frame is
        wrong with the configuration or the data set, and raised."""
        try:
            frame = read(position)
        except (DataError, ValueError) as error:
            if position == 0:
                raise
            log.warning("%s; frame %d is skipped", error, index())
            return None
        if not isinstance(frame, Frame):
            return frame
        timed = self._in_time(position, frame)
        return without_limit(usable(timed), lambda fps: self._elsewhere(position, read, fps)) if timed is not None else None

    def _elsewhere(self, position: int, read: Callable[[int], Any], fps: float) -> Any:
        """A frame half a second away, if it can be read."""
        away = round(AWAY_S * fps)
        try:
            return read(position + away if position + away < self._count else max(position - away, 0)) if self._count else None
        except (DataError, ValueError):
            return None

    def _in_time(self, position: int, frame: Frame) -> Frame | None:
        """The frame, its time after that of the frame before; None for one that comes late."""
        stamp_ns = self._known.get(frame.index, frame.stamp_ns + self._set_back_ns)
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            late_ns = self._last_ns - stamp_ns
            if late_ns < LATE_NS:
                log.warning("frame %d: its time is %.0f ms before that of the frame before it; it is skipped", frame.index, late_ns / 1e6)
                self.late.add(position)
                return None
            log.warning("frame %d: the clock was set back by %.3f s; time goes on from the frame before", frame.index, late_ns / 1e9)
            period_ns = round(1e9 / frame.camera.fps)
            self._set_back_ns += late_ns + period_ns
            stamp_ns = self._last_ns + period_ns
        self._last_ns = stamp_ns
        self._judge_scale(frame.depth_m)
        return frame if stamp_ns == frame.stamp_ns else replace(frame, stamp_ns=stamp_ns)

    def _judge_scale(self, depth_m: F32) -> None:
        """Warn, once, where the first frames are nearer or farther than a room is seen."""
        if len(self._medians_m) >= JUDGED:
            return
        sampled = depth_m[::SAMPLED_PX, ::SAMPLED_PX]
        self._medians_m += [float(np.median(sampled[sampled > 0.0]))] if (sampled > 0.0).any() else []
        median_m = float(np.median(self._medians_m)) if len(self._medians_m) == JUDGED else 1.0
        if not NEAR_M <= median_m <= FAR_M:
            how = "small" if median_m < NEAR_M else "large"
            log.warning("the depth of the first frames is about %.2g m, too %s for a room; is the depth_scale of the camera right?", median_m, how)
