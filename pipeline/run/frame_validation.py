"""Frame validation: images, camera and time of each frame are checked before a stage reads them; faults are reported and skipped."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import F32, Camera, Frame
from trihedron.pipeline.core.value_checks import camera_fault
from trihedron.pipeline.run.frozen_stream import CHANGED_SHARE, COLOR, DEPTH, LATE_SHARE, SAMPLED_PX, STALE_NS, FrozenStream, age_ns
from trihedron.pipeline.run.registration_check import RegistrationCheck

log = logging.getLogger("trihedron")
LATE_NS = 1_000_000_000  # a frame that comes this late or later was not late: the clock was set back
CONSTANT = 0.95  # share of the readings with one value, from which an image of depth counts as constant
CONSTANT_READINGS = 0.01  # of the image, without which nothing is constant
SATURATED, CROWDED = 0.02, 3.0  # a limit: share of the image that has this value, and times the readings of any other depth
LEAST_DEPTH = 0.01  # of the image, with which a run can begin
DARK_NS = 1_000_000_000  # for which black colour at the beginning is that of a camera that starts, not of a dark room
AWAY_S = 0.5  # to a frame that shows surfaces at other distances
JUDGED = 10  # readable frames after which the scale of depth is judged
FARTHEST_M = 1000.0  # beyond this no camera measures depth, and the covariance of a point is singular in double precision
MILLIMETRES = 100.0  # metres, from which the median depth of a frame is one in millimetres
OFF_CENTRE = 0.15  # of width or height: farther from the centre no camera has its principal point, unless images are cropped
GAPS = 5  # between frames, whose median is judged, in periods of the camera
UNITS = ((1e7, "nanoseconds"), (1e4, "microseconds"), (3e2, "milliseconds"))  # periods, from which stamps in this unit were taken for seconds
TINY_GAP = 1e-7  # periods: seconds were taken for nanoseconds
MISSING, SKIPPED = "it counts as missing", "the frame is skipped"
NEAR_M, FAR_M = 0.7, 8.0  # half of the readings nearer, or farther: no room of a house is seen like that (a Kinect measures 0.4 to 8 m)


def usable(frame: Frame) -> Frame | None:
    """Return the frame with readings that are no distance (NaN, infinite, negative, beyond `FARTHEST_M`) as missing; None where camera and images
    differ in size."""
    camera, depth, (h, w) = frame.camera, frame.depth_m, frame.depth_m.shape
    if (camera.width, camera.height) != (w, h):
        log.warning("frame %d: its images are %d×%d while the camera is %d×%d; it is skipped", frame.index, w, h, camera.width, camera.height)
        return None
    if depth.min(initial=0.0) >= 0.0 and depth.max(initial=0.0) <= FARTHEST_M:  # NaN compares false
        return frame
    faulty, far = ~np.isfinite(depth) | (depth < 0.0), np.isfinite(depth) & (depth > FARTHEST_M)
    if faulty.any():
        log.warning("frame %d: %d depth readings are negative or not finite; they count as missing", frame.index, np.count_nonzero(faulty))
    if far.any():
        cause = "frame %d: %d depth readings are beyond %.0f m and count as missing; is the depth_scale of the camera right?"
        log.warning(cause, frame.index, np.count_nonzero(far), FARTHEST_M)
    return replace(frame, depth_m=np.where(faulty | far, np.float32(0.0), depth))


def judge_intrinsics(camera: Camera) -> None:
    """Warn of a principal point far from the image's centre, as intrinsics of another resolution have it."""
    x, y = 2.0 * camera.cx + 1.0, 2.0 * camera.cy + 1.0  # of images that have it in their centre
    w, h = camera.width, camera.height
    if max(abs(x - w) / w, abs(y - h) / h) > 2.0 * OFF_CENTRE:
        log.warning(
            "the principal point cx %.4g, cy %.4g is far from the centre of images of %d×%d: it is the centre of %.0f×%.0f; "
            "give the intrinsics of these images, or ignore this where they are cropped",
            *(camera.cx, camera.cy, w, h, x, y),
        )


def without_limit(frame: Frame | None, look: Callable[[float], Any]) -> Frame | None:
    """Remove the readings that only have the sensor's largest value: a large part of the image has it, here and in the frame that `look` returns,
    from where a surface would be at another distance."""
    if frame is None or (limit_m := _crowded_maximum(frame.depth_m)) == 0.0:
        return frame
    other = look(frame.camera.fps)
    if not isinstance(other, Frame) or other.index == frame.index or _crowded_maximum(other.depth_m) != limit_m:
        return frame
    saturated = frame.depth_m == limit_m
    count = np.count_nonzero(saturated)
    log.warning("frame %d: %d depth readings are %.3f m and none is more, which is a limit; they count as missing", frame.index, count, limit_m)
    return replace(frame, depth_m=np.where(saturated, np.float32(0.0), frame.depth_m))


def _crowded_maximum(depth_m: F32) -> float:
    """Return the largest depth where many readings, and many more than of any other depth, have exactly that value; 0 elsewhere."""
    farthest, sampled = float(depth_m.max(initial=0.0)), depth_m[::SAMPLED_PX, ::SAMPLED_PX]
    if not 0.0 < farthest < np.inf or np.count_nonzero(sampled == farthest) < SATURATED * sampled.size:
        return 0.0
    _, counts = np.unique(depth_m[depth_m > 0.0], return_counts=True)
    return farthest if counts[-1] > CROWDED * counts[:-1].max(initial=0) else 0.0


def constant_share(depth_m: F32) -> float:
    """Return the share of the readings (sampled) that have the median value, which is the commonest one where most are equal; 0 for an image nearly
    without readings."""
    sampled = depth_m[::SAMPLED_PX, ::SAMPLED_PX]
    readings = sampled[sampled > 0.0]
    if readings.size < max(CONSTANT_READINGS * sampled.size, 2):
        return 0.0
    middle = readings.size // 2
    return float(np.count_nonzero(readings == np.partition(readings, middle)[middle]) / readings.size)


def _missing(frame: Frame, running_ns: int) -> str:
    """Return what a run cannot begin without and the frame does not have: depth, or, in the first second, colour; "" for a frame that has both."""
    if np.count_nonzero(frame.depth_m) < LEAST_DEPTH * frame.depth_m.size:
        return "depth"
    return "" if running_ns >= DARK_NS or frame.color.any() else "colour"


class FrameValidation:
    """Reads frames in their order. Frames in `known` have the stamps they were recorded with; `count` frames can be read at any time (0: those of a
    camera, which come once). A run begins with the first frame that shows something: a map that began without depth would have no landmarks.

    `left_out` are the positions of frames that can be read and were skipped: later ones had come before them, or nothing had been shown yet."""

    def __init__(self, known: Mapping[int, int], count: int) -> None:
        self._known, self._count = known, count
        self._last_ns: int | None = None
        self._set_back_ns = 0
        self._medians_m: list[float] = []
        self._gaps: list[float] = []
        self._depth, self._color = FrozenStream(DEPTH), FrozenStream(COLOR)
        self._registration = RegistrationCheck()
        self._camera: Camera | None = None  # the latest that was found without a fault: nearly always that of all frames
        self._first_ns: int | None = None
        self._missing = "" if known else "depth"  # until a frame has all that a run begins with; those before known ones may have had it
        self.left_out: set[int] = set()

    def __call__(self, position: int, read: Callable[[int], Any], index: Callable[[], int]) -> Any:
        """Return the frame that `read` finds at a position, validated, or None; `index` is its number. An error of the first frame is one of the
        configuration or the data set, and raised."""
        try:
            frame = read(position)
            if isinstance(frame, Frame) and frame.camera is not self._camera:
                if fault := camera_fault(frame.camera):
                    raise DataError(f"camera of frame {frame.index}", fault, "check the calibration of the data set")
                self._camera = frame.camera
        except (DataError, ValueError) as error:
            if position == 0:
                raise
            log.warning("%s; frame %d is skipped", error, index())
            return None
        if not isinstance(frame, Frame):
            return frame
        timed = self._in_time(position, frame)
        valid = self._without_faulty_depth(position, self._without_frozen_color(position, usable(timed))) if timed is not None else None
        valid = without_limit(valid, lambda fps: self._elsewhere(position, read, fps))
        return valid if valid is not None and self._begins(position, valid) else None

    def _begins(self, position: int, frame: Frame) -> bool:
        """Return True for a frame that shows something and for those after it; else the frame is left out."""
        self._first_ns = frame.stamp_ns if self._first_ns is None else self._first_ns
        if self._missing:
            self._missing = _missing(frame, frame.stamp_ns - self._first_ns)
        if self._missing:
            log.warning("frame %d: it has no %s, nor has any before it; it is skipped", frame.index, self._missing)
            self.left_out.add(position)
        return not self._missing

    def check_begun(self) -> None:
        """Raise DataError where every frame was skipped because nothing was shown."""
        if self.left_out and self._missing:
            cause = f"none of {len(self.left_out)} frames has {self._missing}"
            raise DataError("dataset", cause, "check its images, and the depth_scale of its camera")

    def _without_faulty_depth(self, position: int, frame: Frame | None) -> Frame | None:
        """Return the frame without its depth where that is constant (saturated, for one) or frozen: whatever is tracked by it is wrong."""
        if frame is None:
            return None
        since, constant = self._depth.since(frame), constant_share(frame.depth_m)
        frozen = since is not None and self._depth.change >= CHANGED_SHARE
        if not frozen and constant >= CONSTANT:
            log.warning("frame %d: %.0f %% of its depth readings are equal; they count as missing", frame.index, 100 * constant)
        outcome = MISSING if frozen and age_ns(frame, since) >= STALE_NS else ""
        self._depth.warn(frame, since, outcome, position + 1 == self._count)
        return replace(frame, depth_m=np.zeros_like(frame.depth_m)) if frozen or constant >= CONSTANT else frame

    def _without_frozen_color(self, position: int, frame: Frame | None) -> Frame | None:
        """Return the frame with black colour where that is frozen: the depth behind its key points is not theirs. Where colour is just late, or
        slower than depth, the frame is left out, since the next one would find no key point in a black image; not a plain one, which has none."""
        if frame is None:
            return None
        since = self._color.since(frame)
        young = self._color.known_rate() or age_ns(frame, since) < STALE_NS
        repeats = since is not None and self._color.change >= (LATE_SHARE if young else CHANGED_SHARE)
        repeats = repeats and not (young and frame.color.min() == frame.color.max())
        self._color.warn(frame, since, (SKIPPED if young else MISSING) if repeats else "", position + 1 == self._count)
        if repeats and young:
            self.left_out.add(position)
            return None
        return replace(frame, color=np.zeros_like(frame.color)) if repeats else frame

    def _elsewhere(self, position: int, read: Callable[[int], Any], fps: float) -> Any:
        """Return a frame half a second away, if it can be read."""
        away = round(AWAY_S * fps)
        try:
            return read(position + away if position + away < self._count else max(position - away, 0)) if self._count else None
        except (DataError, ValueError):
            return None

    def _in_time(self, position: int, frame: Frame) -> Frame | None:
        """Return the frame with a time after that of the frame before; None for one that comes late."""
        stamp_ns = self._known.get(frame.index, frame.stamp_ns + self._set_back_ns)
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            late_ns = self._last_ns - stamp_ns
            if late_ns < LATE_NS:
                log.warning("frame %d: its time is %.0f ms before that of the frame before it; it is skipped", frame.index, late_ns / 1e6)
                self.left_out.add(position)
                return None
            log.warning("frame %d: the clock was set back by %.3f s; time goes on from the frame before", frame.index, late_ns / 1e9)
            period_ns = round(1e9 / frame.camera.fps)
            self._set_back_ns += late_ns + period_ns
            stamp_ns = self._last_ns + period_ns
        if self._last_ns is None:
            judge_intrinsics(frame.camera)
        else:
            self._judge_gap((stamp_ns - self._last_ns) / 1e9 * frame.camera.fps)
        self._last_ns = stamp_ns
        self._judge_scale(frame.depth_m)
        misregistered = self._registration(frame)
        if misregistered:
            log.warning("depth is not registered to colour: %s; register it, or calibrate the two cameras", misregistered)
        return frame if stamp_ns == frame.stamp_ns else replace(frame, stamp_ns=stamp_ns)

    def _judge_gap(self, gap: float) -> None:
        """Warn, once, where the time between frames, in periods of the camera, shows that stamps are in another unit."""
        if len(self._gaps) >= GAPS:
            return
        self._gaps.append(gap)
        median = float(np.median(self._gaps)) if len(self._gaps) == GAPS else 1.0
        taken = next((f"{unit} taken for seconds" for periods, unit in UNITS if median >= periods), "")
        if taken or median <= TINY_GAP:
            apart = "frames are %.2g periods of the camera apart: their time stamps are %s; convert them"
            log.warning(apart, median, taken or "seconds taken for nanoseconds")

    def _judge_scale(self, depth_m: F32) -> None:
        """Warn, once, where the first frames are nearer or farther than a room is seen."""
        if len(self._medians_m) >= JUDGED:
            return
        sampled = depth_m[::SAMPLED_PX, ::SAMPLED_PX]
        self._medians_m += [float(np.median(sampled[sampled > 0.0]))] if (sampled > 0.0).any() else []
        if self._medians_m and MILLIMETRES <= self._medians_m[-1] < np.inf:
            cure = "give a depth_scale 1000 times as large, or divide float depth by 1000"
            log.warning("the depth of frames is about %.0f m, which are millimetres taken for metres; %s", self._medians_m[-1], cure)
            self._medians_m = [1.0] * JUDGED
            return
        median_m = float(np.median(self._medians_m)) if len(self._medians_m) == JUDGED else 1.0
        if not NEAR_M <= median_m <= FAR_M:
            how = "small" if median_m < NEAR_M else "large"
            log.warning("the depth of the first frames is about %.2g m, too %s for a room; is the depth_scale of the camera right?", median_m, how)
