"""Depth or colour that stands still while the other goes on: frozen, or of a lower rate."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from trihedron.pipeline.core.types import F32, U8, Frame

log = logging.getLogger("trihedron")
STALE_NS = 50_000_000  # age from which a repeated image is a fault: a Kinect repeats single images at 30 a second
UNDECIDED_NS = 1_000_000_000  # for which an image may be repeated before it is frozen whatever the rate
RATE_IMAGES = 4  # in a row that each repeat equally often, which shows a slower stream: a Kinect repeats single images here and there
CHANGED_LEVELS, CHANGED_SIGMAS = 16, 7.0  # grey levels, and standard deviations of depth, beyond the noise of an image
CHANGED_SHARE = 0.02  # of the pixels, by which an image has changed
LATE_SHARE = 0.005  # the same where it costs a single frame to be wrong: 0.0024 at rest, at least 0.008 of a slow walk through a synthetic room
SAMPLED_PX = 8  # apart are the pixels by which images are judged


@dataclass(frozen=True)
class Stream:
    """One of the two images of a frame, and the share of the other that has changed beyond noise. `slower` states what becomes of a repeated
    image where the stream is slower, and the cure."""

    name: str
    other: str
    image: Callable[[Frame], F32 | U8]
    other_image: Callable[[Frame], F32 | U8]
    other_change: Callable[[Frame, Frame], float]
    slower: str


class FrozenStream:
    """Detects one stream, depth or colour, that stands still, bit-identical frame after frame, while the other goes on; and one that is slower.

    The other is compared with that of the first frame with this image: the change adds up while the camera moves. A camera at rest shows no change
    beyond its noise.

    `period` is the number of frames from one new image to the next where that is regular, 1 before it is known to be; `undecided` while nothing but
    repeated images came, too few to know. `change` is the share (0 … 1) of the other image that has changed beyond noise since the present one came,
    1 where the stream is known to be slower."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._first: Frame | None = None
        self._length, self._goes_on = 0, False  # frames with the present image, and whether the other was a new one meanwhile
        self._lengths: list[int] = []  # of the images before it, the first of all left out, whose beginning was not seen
        self._images = 0
        self._held: list[str] = []  # warnings of repeated images, which are none where that is the rate of the stream
        self._is_named = False  # as slower
        self.period, self.undecided, self.change = 1, True, 0.0

    def since(self, frame: Frame) -> Frame | None:
        """Return the first frame with the image of this one, if the other image is a new one; else None."""
        first, stream = self._first, self._stream
        if first is None or not _bit_identical(stream.image(first), stream.image(frame)):
            self._count_image()
            self._first, self._length, self._goes_on = frame, 1, False
            return None
        self._length += 1
        self.undecided = self.undecided and frame.stamp_ns - first.stamp_ns < UNDECIDED_NS
        if not stream.image(frame).any() or _bit_identical(stream.other_image(first), stream.other_image(frame)):
            return None
        self._goes_on = True
        self.change = 1.0 if self.period > 1 else stream.other_change(first, frame)
        return first

    def known_rate(self) -> bool:
        """Return True where the stream is known to be slower and the present image is repeated no longer than that and a missed one explain."""
        return self.period > 1 and self._length <= 2 * self.period

    def warn(self, frame: Frame, since: Frame | None, outcome: str, is_last: bool) -> None:
        """Name a slower stream, once; and each frame with a repeated image, that of the frame `since`, if something became of it (`outcome`): as soon
        as it is known that the stream is not slower, at the latest with the last frame."""
        stream, fps = self._stream, frame.camera.fps
        if self.period > 1 and not self._is_named:
            self._is_named = True
            self._held.clear()
            which = {2: "second", 3: "third"}.get(self.period, f"{self.period}th")
            seen = f"about {fps / self.period:.3g} Hz instead of {fps:.3g}: only every {which} {stream.name} image is new"
            cure = stream.slower.format(fresh=f"dataset.frames={frame.index % self.period}::{self.period}")
            log.warning("%s is slower than %s, %s, %s", stream.name, stream.other, seen, cure)
        if since is not None and outcome and not self.known_rate():
            cause = f"its {stream.name} is that of frame {since.index}, bit for bit, while {stream.other} has changed"
            self._held.append(f"frame {frame.index}: {cause}; {outcome}")
        if not self.undecided or is_last:
            for line in self._held:
                log.warning("%s", line)
            self._held.clear()

    def _count_image(self) -> None:
        """Count how often an image came, when the next comes. One that is repeated while the other is, too, shows nothing."""
        self._images += self._first is not None
        if self.period > 1 or self._images < 2 or (self._length > 1 and not self._goes_on):
            return
        self._lengths = [*self._lengths, self._length][-RATE_IMAGES:]
        regular = len(set(self._lengths)) == 1
        if regular and self._length > 1 and len(self._lengths) == RATE_IMAGES:
            self.period = self._length
        self.undecided = self.undecided and regular and self._length > 1 and self.period == 1


def age_ns(frame: Frame, since: Frame | None) -> int:
    """Return the time from a frame to this one; 0 for none."""
    return frame.stamp_ns - since.stamp_ns if since is not None else 0


def color_change(a: Frame, b: Frame) -> float:
    """Return the share of the pixels whose colour has changed beyond image noise."""
    return float((np.abs(_sampled_gray(b) - _sampled_gray(a)) > CHANGED_LEVELS).mean())


def depth_change(a: Frame, b: Frame) -> float:
    """Return the share of the pixels, with readings in both frames, whose depth has changed beyond the noise of the sensor."""
    before, now = (frame.depth_m[::SAMPLED_PX, ::SAMPLED_PX] for frame in (a, b))
    both = (before > 0.0) & (now > 0.0)
    changed = np.abs(now - before)[both] > CHANGED_SIGMAS * b.camera.depth_noise.sigma_m(np.maximum(before, now)[both])
    return np.count_nonzero(changed) / both.size


def _bit_identical(a: F32 | U8, b: F32 | U8) -> bool:
    """Compare a row first: two images that differ nearly always differ there."""
    row = len(a) // 2
    return np.array_equal(a[row : row + 1], b[row : row + 1]) and np.array_equal(a, b)


def _sampled_gray(frame: Frame) -> F32:
    return np.asarray(frame.color[::SAMPLED_PX, ::SAMPLED_PX].mean(axis=2, dtype=np.float32))


DEPTH = Stream(
    "depth", "colour", attrgetter("depth_m"), attrgetter("color"), color_change,
    "a repeated one counts as missing; record depth at the rate of colour, or take the frames with new depth alone: {fresh}",
)  # fmt: skip
COLOR = Stream(
    "colour", "depth", attrgetter("color"), attrgetter("depth_m"), depth_change,
    "frames that repeat one are skipped; give more light, with which most cameras are faster, or record depth at the rate of colour",
)  # fmt: skip
