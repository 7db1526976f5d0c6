"""Arrays to frames: each argument is checked and named in the error."""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np

from trihedron.camera import Camera
from trihedron.datasets.readers.images import metres
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import F32, U8, Frame
from trihedron.pipeline.record.trajectories import parse_stamp_ns


class Frames:
    """Makes frames of arrays: copied, in metres, undistorted, without the skew of a rolling shutter as far as frames come one after the other. Raises
    DataError naming the argument."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._calibration = camera.calibration
        self._rectification = self._calibration.rectification
        self._steady = self._calibration.steady_frames(lambda number: None)  # by the frames before

    def __call__(self, index: int, stamp_ns: int, rgb: object | None, depth: object | None) -> Frame:
        """Make frame `index` of rgb (h, w, 3) uint8 and depth (h, w), in metres or uint16 / depth_scale. None is a missing image: black, or without
        readings, as frame validation replaces a faulty one."""
        size = self.camera.height, self.camera.width
        color = self._color(rgb) if rgb is not None else np.zeros((*size, 3), np.uint8)
        depth_m = self._depth(depth) if depth is not None else np.zeros(size, np.float32)
        color, depth_m = self._rectification.color(color), self._rectification.depth(depth_m)
        frame = Frame(index, stamp_ns, color, depth_m, self._calibration.camera)
        return frame if self._steady is None else self._steady(index, frame)

    def _color(self, given: object) -> U8:
        image = np.asarray(given)
        if image.ndim == 2:
            raise DataError("rgb", "has no channels", "give (h, w, 3), a gray image as np.stack([gray] * 3, axis=-1)")
        self._check_shape("rgb", image.shape, 3)
        if image.dtype != np.uint8:
            raise DataError("rgb", f"holds {image.dtype}, not uint8", "give values from 0 to 255 as np.uint8")
        return np.array(image, np.uint8, order="C")

    def _depth(self, given: object) -> F32:
        image = np.asarray(given)
        self._check_shape("depth", image.shape)
        if image.dtype == np.uint16:
            scale = self.camera.depth_scale
            if scale <= 0.0:
                raise DataError("depth", "holds uint16, and the camera has no depth_scale", "give Camera(..., depth_scale=1000) for millimetres")
            return metres(image, scale)
        if image.dtype.kind != "f":
            raise DataError(
                "depth", f"holds {image.dtype}, neither metres nor uint16", "give float metres, or np.uint16 and the camera's depth_scale"
            )
        depth_m = np.array(image, np.float32, order="C")
        if not (depth_m.min() >= 0.0 and depth_m.max() < np.inf):  # NaN compares false
            wrong = int(np.count_nonzero(~(np.isfinite(depth_m) & (depth_m >= 0.0))))
            raise DataError("depth", f"holds {wrong} readings that are NaN, infinite or negative", "give 0 where there is none: np.nan_to_num(depth)")
        return depth_m

    def _check_shape(self, name: str, shape: tuple[int, ...], *channels: int) -> None:
        expected = (self.camera.height, self.camera.width, *channels)
        if shape != expected:
            raise DataError(name, f"has the shape {shape}, the camera's images have {expected}", _cure_of_shape(name, shape, expected))


def _cure_of_shape(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> str:
    """Return the cure of an array that has other channels, or in another place, than the camera's images (h, w) or (h, w, 3)."""
    size, color = expected[:2], len(expected) == 3
    if shape == (*size, 1):
        return f"give np.repeat({name}, 3, axis=2)" if color else f"give {name}[:, :, 0]"
    if len(shape) == 3 and shape[:2] == size and shape[2] > (3 if color else 1):
        return f"give {name}[:, :, :3]" if color else f"give one channel: {name}[:, :, 0]"
    if len(shape) == 3 and shape[1:] == size:
        return f"give the channels last: {name}.transpose(1, 2, 0)" if color else f"give {name}[0]"
    return "give images of the camera's size"


def stamp_of(t: Any, last_ns: int | None) -> int:
    """Return the time in ns of the argument `t` in seconds, without the rounding of a float. Raises DataError unless it comes after `last_ns`."""
    try:
        if isinstance(t, str | bytes):
            raise TypeError
        seconds = operator.index(t) if hasattr(t, "__index__") else float(t)
    except (TypeError, ValueError):
        raise DataError("t", f"is {type(t).__name__}, not a number of seconds", "give the time of the frame in seconds") from None
    if not math.isfinite(seconds) or seconds < 0:
        raise DataError("t", f"is {seconds}", "give the time of the frame in seconds, 0 or later")
    try:
        stamp_ns = parse_stamp_ns(repr(seconds))
    except ValueError:
        raise DataError("t", f"is {seconds}, too large for seconds", "divide nanoseconds by 1e9, milliseconds by 1e3") from None
    if last_ns is not None and stamp_ns <= last_ns:
        raise DataError("t", f"is {stamp_ns / 1e9:.9f} s, not after the frame before, {last_ns / 1e9:.9f} s", "push frames in order of time")
    return stamp_ns
