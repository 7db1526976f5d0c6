"""The rolling shutter of a camera, undone: images with all rows at the time of the middle one.

Rows are read one after the other: what the last row shows is later than the first by the readout time, so that the image of a camera that turns is
skewed. The rate of turning is measured in the images themselves. Corners are tracked from one small image to the next (Shi and Tomasi, 1994;
Bouguet, 2000), and one rotation explains them, the mean of what the translation moves included. Each row is turned back by its part of the readout.
No pose of the run enters, so that a frame depends on the images up to it alone; the first one on the second.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from trihedron.datasets.readers.registration import fixed_point
from trihedron.datasets.readers.rolling_shutter_kernels import fit_rotation, pixels_read
from trihedron.pipeline.core.lie import skew
from trihedron.pipeline.core.linalg import inv, matmul, norm
from trihedron.pipeline.core.types import F32, F64, U8, Camera, Frame

WIDTH_PX = 160  # of the images compared, at most
CORNERS, LEAST_CORNERS = 200, 12
QUALITY, APART_PX = 0.01, 5.0  # of corners: of the strongest one; between two
WINDOW_PX, LEVELS = 15, 4  # of the tracks
BACK_PX = 0.5  # between a corner and where its track leads back to
NOISE_PX = 0.2  # of tracks, at least
ROUNDS = 10  # of the robust fit
LONGEST_S = 0.25  # between images whose mean rate is taken for that of the moment
FASTEST = 10.0  # rad/s; faster turns have no tracks
LEAST_FACTOR = 0.5  # of depth, by the rotation of a row
STILL_PX = 0.05  # by which no row moves more: then the image stays as it was
KEPT = 4  # frames of which something is kept
BLOCK_ROWS = 32  # turned at once, so that what is computed for them stays in the cache


class Look(NamedTuple):
    """A frame as far as it is kept: its number and stamp, and a small grey image."""

    number: int
    stamp_ns: int
    small: U8


def look_at(number: int, stamp_ns: int, color: U8) -> Look:
    """Return the look of a colour image (h, w, 3)."""
    gray = np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.uint8)
    times = max(round(gray.shape[1] / WIDTH_PX), 1)
    size = max(gray.shape[1] // times, 1), max(gray.shape[0] // times, 1)
    return Look(number, stamp_ns, np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8) if times > 1 else gray)


class SteadyFrames:
    """Frames of a camera with all rows at one time, that of the middle row of colour, whichever are asked for, from any thread.

    `readout_s` is the time from the first row of colour to the last, negative where the last is read first; `depth_readout_s` the same of depth.
    `read(number)` returns the look of another frame, None where there is none. An image that repeats the last one is turned back as that was, and
    stays equal to it. The middle row of depth was `depth_later_s(number)` after that of colour."""

    def __init__(
        self,
        camera: Camera,
        readout_s: float,
        depth_readout_s: float,
        read: Callable[[int], Look | None],
        depth_later_s: Callable[[int], float] = lambda number: 0.0,
    ) -> None:
        self._camera, self._readout_s, self._depth_readout_s = camera, readout_s, depth_readout_s
        self._read, self._depth_later_s = read, depth_later_s
        self._looks: dict[int, Look | None] = {}  # of the last frames that were asked for
        self._shown: dict[int, Look] = {}  # the same, of the frame that first showed the image
        self._turns: dict[tuple[int, int], F64 | None] = {}  # between two frames
        self._rates: dict[int, F64 | None] = {}  # at frames that were the first to show their image
        self._lock = threading.Lock()

    def __call__(self, number: int, frame: Frame) -> Frame:
        """Return frame `number` as if all rows had been read with the middle one of colour; as it was where the rate of turning is not known."""
        with self._lock:
            _keep(self._looks, number, look_at(number, frame.stamp_ns, frame.color))
            shown = self._first_shown(number)
            if shown is not None and shown.number not in self._rates:
                _keep(self._rates, shown.number, self._rate(shown.number))
            rate = self._rates[shown.number] if shown is not None else None
        if rate is None:
            return frame
        color = self._turned_back(frame.color, rate, self._readout_s, 0.0)
        return replace(frame, color=color, depth_m=self._turned_back(frame.depth_m, rate, self._depth_readout_s, self._depth_later_s(number)))

    def _turned_back(self, image: NDArray[Any], rate: F64, readout_s: float, later_s: float) -> NDArray[Any]:
        """The image, of colour or depth, with all rows `later_s` before the time of its middle one; as it was where no row would move by a twentieth
        of a pixel, or where one would turn too far to be seen."""
        camera, is_depth = self._camera, image.ndim == 2
        if (0.5 * abs(readout_s) + abs(later_s)) * norm(rate) * max(camera.fx, camera.fy) < STILL_PX:
            return image
        turned, columns = np.empty_like(image), np.arange(camera.width, dtype=np.float32)
        start, slope = row_lines(camera, rate, readout_s, later_s)
        if not min(start[:, 2].min(), (start[:, 2] + columns[-1] * slope[:, 2]).min()) > LEAST_FACTOR:
            return image
        for first in range(0, camera.height, BLOCK_ROWS):
            block = slice(first, first + BLOCK_ROWS)
            x, y, factors = pixels_read(start[block], slope[block], columns)
            if is_depth:
                cv2.remap(image, x, y, cv2.INTER_NEAREST, dst=turned[block], borderMode=cv2.BORDER_CONSTANT)
                turned[block] /= factors
            else:
                cv2.remap(image, *fixed_point(x, y), cv2.INTER_LINEAR, dst=turned[block], borderMode=cv2.BORDER_REPLICATE)
        return turned

    def _rate(self, number: int) -> F64 | None:
        """(3,) rad/s at the time of a frame: the mean since the one before, carried on as it changed; the one that follows where there is none."""
        before, last = self._first_shown(number - 1), self._mean_rate(number)
        if before is None:
            following = self._mean_rate(number + 1)
            return following[0] if following is not None else None
        if last is None:
            return None
        earlier = self._mean_rate(before.number)
        return last[0] if earlier is None else np.asarray(last[0] + (last[0] - earlier[0]) * last[1] / (last[1] + earlier[1]))

    def _mean_rate(self, number: int) -> tuple[F64, float] | None:
        """(3,) mean rate from the image before to that of a frame, rad/s, and the seconds between them; None where it cannot be measured."""
        before, now = self._first_shown(number - 1), self._look(number)
        if before is None or now is None or not 0 < now.stamp_ns - before.stamp_ns <= LONGEST_S * 1e9:
            return None
        seconds, between = (now.stamp_ns - before.stamp_ns) / 1e9, (before.number, number)
        if between not in self._turns:
            _keep(self._turns, between, rotation_between(before.small, now.small, self._camera, self._readout_s / seconds))
        turn = self._turns[between]
        return (turn / seconds, seconds) if turn is not None and norm(turn) <= FASTEST * seconds else None

    def _first_shown(self, number: int) -> Look | None:
        """The look of the frame that first showed the image of this one."""
        first, found = number, self._shown.get(number) or self._look(number)
        while found is not None and first not in self._shown and (before := self._look(first - 1)) and np.array_equal(before.small, found.small):
            first, found = first - 1, self._shown.get(first - 1) or before
        if found is not None:
            _keep(self._shown, number, found)
        return found

    def _look(self, number: int) -> Look | None:
        if number not in self._looks:
            _keep(self._looks, number, self._read(number) if number >= 0 else None)
        return self._looks[number]


def _keep(kept: dict[Any, Any], key: Any, value: Any) -> None:
    """Add a value, and forget the oldest beyond KEPT."""
    kept[key] = value
    while len(kept) > KEPT:
        del kept[next(iter(kept))]


def rotation_between(first: U8, second: U8, camera: Camera, readout: float) -> F64 | None:
    """Estimate the rotation vector (3,) of `R_second_first` from two small images of a camera; `readout` is a share of the time between them.

    The image of a static scene moves with `J w` where the camera's rotation moves it by w (Longuet-Higgins and Prazdny, 1980), taken half way between
    the two places, which leaves the third power of the angle. A corner that moved to a later row had more time. Least squares with Cauchy's weights.
    None for images that are equal, or have too few corners in common."""
    if first.shape != second.shape or np.array_equal(first, second):
        return None
    corners = cv2.goodFeaturesToTrack(first, CORNERS, QUALITY, APART_PX)
    if corners is None:
        return None
    window = {"winSize": (WINDOW_PX, WINDOW_PX), "maxLevel": LEVELS}
    found, tracked, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, **window)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, found, None, **window)
    good = (tracked[:, 0] > 0) & (returned[:, 0] > 0) & (np.abs(back - corners).max(axis=(1, 2)) < BACK_PX)
    if np.count_nonzero(good) < LEAST_CORNERS:
        return None
    scale = camera.width / first.shape[1]
    center, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    before, after = ((scale * (p[good, 0].astype(np.float64) + 0.5) - 0.5 - center) / focal for p in (corners, found))
    times = 1.0 + readout * camera.fy / camera.height * (after[:, 1] - before[:, 1])
    weights, turn = np.ones(len(times)), np.zeros(3)
    for _ in range(ROUNDS):
        turn, errors = fit_rotation(before, after, times, weights)
        weights = 1.0 / (1.0 + (errors / max(1.4826 * float(np.sort(errors)[len(errors) // 2]), NOISE_PX * scale / camera.fx)) ** 2)
    return turn


def row_lines(camera: Camera, rate: F64, readout_s: float, later_s: float = 0.0) -> tuple[F32, F32]:
    """Locate the rows of an image of one moment in the image that was read row by row while the camera turned.

    Args:
        camera: of the images.
        rate: (3,) rad/s; directions in the camera's frame turn by `rate × time`.
        readout_s: from the first row to the last.
        later_s: from the moment to the middle row.

    Returns:
        (h, 3) homogeneous pixel of the image that was read for the first pixel of each row, and (h, 3) what each further one adds. The third
        component is the factor of the depth there.
    """
    rows = np.arange(camera.height)
    # a row that moves while the image is read, by -fy rate[0] t in the middle, is read that much earlier or later
    slower = max(1.0 + readout_s * camera.fy * float(rate[0]) / camera.height, 0.1)
    times_s = (later_s + readout_s * ((rows + 0.5) / camera.height - 0.5)) / slower
    angle = norm(rate)
    axis = skew(rate / angle)
    turned, turned_twice = matmul(camera.K, axis, inv(camera.K)), matmul(camera.K, axis, axis, inv(camera.K))  # Rodrigues' formula
    sine, cosine = np.sin(angle * times_s)[:, None, None], np.cos(angle * times_s)[:, None, None]
    H = np.eye(3) + sine * turned + (1.0 - cosine) * turned_twice
    return (H[..., 1] * rows[:, None] + H[..., 2]).astype(np.float32), H[..., 0].astype(np.float32)
