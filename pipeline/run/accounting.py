"""The accounts of a run: poses, counts and times, taken frame by frame."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import Frame, Map, Pose, Value
from trihedron.pipeline.run.poses import Poses
from trihedron.pipeline.run.stated_sigma import calibration_variance_m2
from trihedron.pipeline.run.timing import Timing

UNREADABLE_SHARE = 0.1


@dataclass
class Result:
    """The outcome of a run: poses in frame order, the last map, the results of folds, counts."""

    poses: Poses | list[Pose] = field(default_factory=Poses)
    map: Map | None = None
    loaded_keyframes: int = 0  # of another run, whose frame numbers mean nothing here
    folds: dict[str, Value] = field(default_factory=dict)
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))  # of every readable frame
    unreadable: int = 0
    fps: float = 30.0  # nominal, of the camera
    calibration_m2: array[float] = field(default_factory=lambda: array("d"))  # of each pose, what its position's variance owes to the calibration


@dataclass
class FrameTimes:
    """Milliseconds of each stage's call at one frame, when the frame was handed over (perf_counter), and from then to its pose."""

    calls_ms: dict[str, float] = field(default_factory=dict)
    handed_over_s: float | None = None
    latency_ms: float | None = None


class Accounting:
    """Keeps the books of a run. Stages report their calls from any thread, each frame's before it is taken."""

    def __init__(self, stamps_ns: Mapping[int, int], fps: float | None, loaded: Map | None) -> None:
        """`stamps_ns` of frames that are known beforehand, `loaded` the map that the run begins with."""
        self.timing = Timing()
        self.result = Result(Poses(), loaded, loaded_keyframes=len(loaded.keyframes) if loaded is not None else 0)
        self.result.fps = fps or self.result.fps
        self.stamps_ns = dict(stamps_ns)
        self.times: dict[int, FrameTimes] = {}

    def frame_read(self, position: int, began_s: float, ended_s: float, handed_over_s: float) -> None:
        """Note the call of the data set, and when the frame was there for the stages: the latency counts from then."""
        times = self.times_at(position)
        times.calls_ms["dataset"] = 1e3 * (ended_s - began_s)
        times.handed_over_s = handed_over_s

    def stage_called(self, position: int, stage: str, began_s: float, ended_s: float) -> None:
        """Note the call of another stage."""
        times = self.times_at(position)
        times.calls_ms[stage] = 1e3 * (ended_s - began_s)
        if stage == "pose":
            times.latency_ms = 1e3 * (ended_s - (began_s if times.handed_over_s is None else times.handed_over_s))

    def take(self, position: int, index: int, values: Mapping[str, Any], count: int, left_out: bool) -> bool:
        """Add the values of a frame to the result; False where the frame cannot be read. Frames that were `left_out` do not count as unreadable.

        Raises DataError when too many of `count` frames cannot be read."""
        if not values:  # the data set failed
            return False
        times = self.times_at(position)
        for name, ms in times.calls_ms.items():
            self.timing.add_call(name, ms)
        if "dataset" in values and values["dataset"] is None:
            self._skip(count, left_out)
            return False
        times.latency_ms = sum(times.calls_ms.values()) if times.latency_ms is None else times.latency_ms
        self.timing.add_frame(times.latency_ms)
        first = next((v for v in values.values() if isinstance(v, Value) and v.index == index), None)
        self.result.stamps_ns.append(self.stamps_ns.setdefault(index, first.stamp_ns if first is not None else 0))
        if isinstance(frame := values.get("dataset"), Frame):
            self.result.fps = frame.camera.fps
        if isinstance(pose := values.get("pose"), Pose):
            self.result.poses.append(pose)
            self.result.calibration_m2.append(calibration_variance_m2(pose))
        if isinstance(latest := values.get("map"), Map):
            self.result.map = latest
        return True

    def _skip(self, count: int, left_out: bool) -> None:
        self.result.unreadable += not left_out
        if self.result.unreadable > UNREADABLE_SHARE * count:
            cause = f"{self.result.unreadable} of {count} frames cannot be read"
            raise DataError("dataset", cause, "see the warnings above for the first file; the data set is damaged")

    def forget(self, position: int, index: int) -> None:
        """Drop the times and the stamp of a frame that is done."""
        self.times.pop(position, None)
        self.stamps_ns.pop(index, None)

    def times_at(self, position: int) -> FrameTimes:
        """Return the times of a frame, for its calls to be added."""
        return self.times.setdefault(position, FrameTimes())
