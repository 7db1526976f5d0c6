"""Live frames of an Intel RealSense camera."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from trihedron.datasets.readers.cameras import stereo_noise
from trihedron.datasets.readers.registration import Undistortion
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.libraries import imports_of
from trihedron.pipeline.core.options import Frames, PositiveInt, frame_range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Camera, DepthNoise, Frame, Trajectory

log = logging.getLogger("trihedron")
ENDLESS = 1 << 30
TIMEOUT_MS = 5000  # without a frame the camera is gone
LENS = "distortion.brown_conrady"  # the one model that OpenCV undoes; without coefficients any will do


class Arrival(NamedTuple):
    """Number of a frame, and when it came (time.perf_counter)."""

    number: int
    at_s: float


@register("dataset", "realsense")
@dataclass(frozen=True)
class RealSense:
    """A camera by itself (`pip install 'trihedron[realsense]'`): frames come when they come, those for which a run is too late are dropped, and
    those taken are embedded in the recording. Depth is registered to colour by the maker's library. Ends after `frames`, or with Ctrl-C."""

    frames: Frames = ""  # 0:B, to end after frame B - 1; empty = until interrupted
    serial: str = ""  # of the camera, where there are several
    width: PositiveInt = 640
    height: PositiveInt = 480
    fps: PositiveInt = 30

    def __post_init__(self) -> None:
        chosen = frame_range(self.frames)
        if chosen.start != 0 or chosen.step != 1:
            raise ValueError("frames: a camera begins with frame 0, and gives every frame")

    def __len__(self) -> int:
        return min(frame_range(self.frames).stop, ENDLESS)

    def start(self) -> None:
        """Begin with frame 0. Raises LibraryError without the maker's library, DataError without the camera."""
        self._stream.begin()

    def wait(self, after: int) -> Arrival | None:
        """The newest frame later than `after`; None when the camera is gone or enough have come."""
        arrival = self._stream.newest(after)
        return arrival if arrival is not None and arrival.number < len(self) else None

    def stop(self) -> None:
        """Turn the camera off."""
        self._stream.end()

    def __call__(self, index: int) -> Frame | None:
        """The frame that was waited for."""
        return self._stream.frame(index)

    def truth(self) -> Trajectory | None:
        """Nobody knows."""
        return None

    @cached_property
    def _stream(self) -> _Stream:
        with imports_of("pyrealsense2"):
            import pyrealsense2
        return _Stream(pyrealsense2, self)


class _Stream:
    """The camera's stream: a thread keeps the newest pair of images."""

    def __init__(self, library: Any, options: RealSense) -> None:
        self._library, self._options = library, options
        self._there = threading.Condition()
        self._thread: threading.Thread | None = None
        self._running = False

    def begin(self) -> None:
        rs, options = self._library, self._options
        self.end()
        config = rs.config()
        if options.serial:
            config.enable_device(options.serial)
        config.enable_stream(rs.stream.color, options.width, options.height, rs.format.rgb8, options.fps)
        config.enable_stream(rs.stream.depth, options.width, options.height, rs.format.z16, options.fps)
        self._pipeline, self._align = rs.pipeline(), rs.align(rs.stream.color)
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise DataError("dataset=realsense", f"the camera does not start: {error}", "plug it in, or choose another size and rate") from error
        sensor = profile.get_device().first_depth_sensor()
        self._scale = float(sensor.get_depth_scale())
        color, depth = (profile.get_stream(stream).as_video_stream_profile().get_intrinsics() for stream in (rs.stream.color, rs.stream.depth))
        self._camera, self._lens = self._calibration(color, self._depth_noise(sensor, float(depth.fx)))
        self._number, self._newest, self._taken = -1, None, (-1, None)
        self._came_s, self._last_stamp = 0.0, -1
        self._running = True
        self._thread = threading.Thread(target=self._keep, name="realsense", daemon=True)
        self._thread.start()

    def _depth_noise(self, sensor: Any, focal_px: float) -> DepthNoise:
        """The noise of a stereo camera, which states its baseline in mm; that of a Kinect for another, which is no less."""
        baseline = self._library.option.stereo_baseline
        return stereo_noise(focal_px, 1e-3 * float(sensor.get_option(baseline))) if sensor.supports(baseline) else DepthNoise()

    def _calibration(self, found: Any, noise: DepthNoise) -> tuple[Camera, Undistortion]:
        coefficients = np.array(found.coeffs, float)
        if coefficients.any() and str(found.model) != LENS:
            raise DataError("dataset=realsense", f"the distortion model '{found.model}' is not known", "choose a size whose colour is undistorted")
        camera = Camera(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy, float(self._options.fps), noise)
        return camera, Undistortion(camera, tuple(coefficients.tolist()) if coefficients.any() else ())

    def _keep(self) -> None:
        """Take every pair as it comes and keep the newest."""
        while self._running:
            try:
                pair = self._align.process(self._pipeline.wait_for_frames(TIMEOUT_MS))
            except RuntimeError as error:
                if self._running:
                    log.warning("the camera is gone: %s", error)
                with self._there:
                    self._running = False
                    self._there.notify_all()
                return
            with self._there:
                self._number, self._newest, self._came_s = self._number + 1, pair, time.perf_counter()
                self._there.notify_all()

    def newest(self, after: int) -> Arrival | None:
        with self._there:
            self._there.wait_for(lambda: self._number > after or not self._running)
            if self._number <= after:
                return None
            self._taken = (self._number, self._newest)
            return Arrival(self._number, self._came_s)

    def frame(self, number: int) -> Frame | None:
        with self._there:
            taken, pair = self._taken
        color, depth = (pair.get_color_frame(), pair.get_depth_frame()) if taken == number and pair is not None else (None, None)
        if not color or not depth:
            log.warning("the camera sent no pair of images; frame %d is skipped", number)
            return None
        stamp_ns = max(round(float(color.get_timestamp()) * 1e6), self._last_stamp + 1)
        self._last_stamp = stamp_ns
        pixels = np.array(color.get_data(), np.uint8)
        depth_m = np.array(depth.get_data(), np.uint16).astype(np.float32) * np.float32(self._scale)
        return Frame(number, stamp_ns, self._lens.color(pixels), self._lens.depth(depth_m), self._camera)

    def end(self) -> None:
        running, self._running = self._running, False
        with self._there:
            self._there.notify_all()
        if running:
            self._pipeline.stop()
        if self._thread is not None:
            self._thread.join(TIMEOUT_MS / 1e3)
            self._thread = None
