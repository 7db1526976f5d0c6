"""Another data set with faults of sensors: for tests of a system under them, and for experiments with noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np

from trihedron.datasets.faults import images as spoil
from trihedron.datasets.faults.joined import Joined
from trihedron.datasets.faults.timing import Delivery, inside
from trihedron.datasets.readers.sequence import clip_range
from trihedron.pipeline.core.errors import DataError, did_you_mean
from trihedron.pipeline.core.options import Frames, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, Share
from trihedron.pipeline.core.registry import plugin_class, register
from trihedron.pipeline.core.types import F32, U8, CalibrationSigmas, Camera, Frame, Trajectory


class Covered(Enum):
    """The image that a cover blinds; depth becomes 0."""

    both = "both"
    color = "color"
    depth = "depth"


class Cover(Enum):
    """Appearance of a cover in colour: black, the light that blinds it, a hand, or random pixels."""

    black = "black"
    white = "white"
    hand = "hand"
    random = "random"


EACH, ALL, SHUFFLED, GRAIN = 5, 6, 9, 10  # streams of random numbers: one a frame, one for all frames, of the order of colour, of its noise


@register("dataset", "faults")
@dataclass(frozen=True)
class Faults:
    """The data set `of` as a bad day would deliver it. Frames are numbered as they arrive; ranges are of the numbers in the data set underneath.
    What is random depends on the seed and the frame alone. Its camera states the default `sigmas`, as faults are of the calibration, too."""

    frames: Frames = ""  # part to read, half open: A:B, A:, :B, every S-th A:B:S; empty = all
    of: str = "synthetic"  # the data set underneath
    options: dict[str, Any] = field(default_factory=dict)  # its options: +dataset.options.path=FOLDER
    cover: Frames = ""  # frames A:B for which the camera is covered; empty = never
    covered: Covered = Covered.both  # both | color | depth
    cover_with: Cover = Cover.black  # black | white | hand | random: what colour shows then
    drop: Frames = ""  # frames A:B that are not delivered
    drop_share: Share = 0.0  # of the others, here and there
    every: PositiveInt = 1  # only one in so many is delivered: 6 makes 5 Hz of 30
    freeze: Frames = ""  # frames A:B that show what A does
    reverse: Frames = ""  # frames A:B that are delivered last first
    jump: NonNegativeInt = 0  # frame from which on the clock is wrong by jump_s
    jump_s: float = 0.0  # added to the stamps from then on
    during: Frames = ""  # frames A:B with the faults below; empty = all
    depth_noise: NonNegativeFloat = 0.0  # added, times the sensor's standard deviation
    depth_holes: Share = 0.0  # share of the depth image that is missing, in blobs
    depth_limit_m: NonNegativeFloat = 0.0  # readings beyond have this value; 0 = none
    not_finite: Share = 0.0  # share of the readings that are NaN or infinite
    depth_times: PositiveFloat = 1.0  # depth is wrong by this factor
    depth_resize: PositiveFloat = 1.0  # size of the depth image, times that of colour
    focal_times: PositiveFloat = 1.0  # the stated focal lengths are wrong by this factor
    resize: PositiveFloat = 1.0  # resolution, times what it was; the stated camera is right
    gamma: PositiveFloat = 1.0  # of colour
    color_noise: NonNegativeFloat = 0.0  # standard deviation, grey levels; new in each frame, also where colour alone is frozen
    exposure_ms: NonNegativeFloat = 0.0  # motion blur of colour
    readout_ms: NonNegativeFloat = 0.0  # from the first row to the last: rolling shutter
    moving: Share = 0.0  # share of the image covered by what moves
    reflecting: Share = 0.0  # share of the image with mirrors and glass
    seed: NonNegativeInt = 0
    frozen: Covered = Covered.both  # both | color | depth: the images that freeze
    frozen_share: Share = 1.0  # of them, from the left, that freezes
    shuffle: bool = False  # colour is that of any frame, at random
    mirror: bool = False  # colour is mirrored left to right, depth is not
    join: NonNegativeInt = 0  # frame from which on the images are of another recording; 0 = none
    joined: dict[str, Any] = field(default_factory=dict)  # options of that where they differ: +dataset.joined.seed=1
    depth_every: PositiveInt = 1  # only one depth image in so many is new, the next repeat it: 2 makes depth at 15 Hz of 30
    color_every: PositiveInt = 1  # the same of colour

    def __post_init__(self) -> None:
        if self.of == "faults" or "frames" in {**self.options, **self.joined}:
            raise ValueError("of, options: another data set, its frames chosen by dataset.frames")
        _ = self._inner  # whose options are refused now when they are out of range

    def __len__(self) -> int:
        return len(self._range)

    def __call__(self, index: int) -> Frame | None:
        """Frame `index` of the selection. Raises DataError where depth and colour differ in size."""
        arrived = self._range[index]
        number = int(self._delivered_frames[arrived])
        shown = self._delivery.source_frame(number)
        frame: Frame | None = self._inner(shown)
        timed: Frame | None = frame if shown == number else self._inner(number)
        if frame is None or timed is None:
            return None
        if shown != number and (self.frozen is not Covered.both or self.frozen_share < 1.0):
            color = timed.color if self.frozen is Covered.depth else spoil.partly(frame.color, timed.color, self.frozen_share)
            depth = timed.depth_m if self.frozen is Covered.color else spoil.partly(frame.depth_m, timed.depth_m, self.frozen_share)
            shown, frame = number, replace(timed, color=color, depth_m=depth)
        if number % self.depth_every and (slow := self._inner(number - number % self.depth_every)) is not None:
            frame = replace(frame, depth_m=slow.depth_m)
        if number % self.color_every and (slow := self._inner(number - number % self.color_every)) is not None:
            frame = replace(frame, color=slow.color)
        color, depth, camera = self._cover_images(number, *self._spoilt(shown, frame))
        return Frame(arrived, self._delivery.stamp_ns(timed.stamp_ns, number), color, depth, replace(camera, sigmas=CalibrationSigmas()))

    def truth(self) -> Trajectory | None:
        """That of the data set underneath, at the true times."""
        truth: Trajectory | None = self._inner.truth()
        return truth

    def _cover_images(self, number: int, color: U8, depth: F32, camera: Camera) -> tuple[U8, F32, Camera]:
        if not inside(self.cover, np.array([number]))[0]:
            return color, depth, camera
        if self.covered is not Covered.depth:
            color = self._cover(color.shape, self._rng(EACH, number))
        return color, depth if self.covered is Covered.color else np.zeros_like(depth), camera

    def _cover(self, shape: tuple[int, ...], rng: np.random.Generator) -> U8:
        if self.cover_with is Cover.hand:
            return spoil.hand(shape, rng)
        if self.cover_with is Cover.random:
            return rng.integers(0, 256, shape, np.uint8)
        return np.full(shape, 255 if self.cover_with is Cover.white else 0, np.uint8)

    def _spoilt(self, number: int, frame: Frame) -> tuple[U8, F32, Camera]:
        """Colour, depth and camera of a frame with the faults of `during`: first the scene's, then the sensor's, then the stated camera."""
        color, depth, camera = frame.color, frame.depth_m, frame.camera
        if self.during and not inside(self.during, np.array([number]))[0]:
            return color, depth, camera
        rng, at_s = self._rng(EACH, number), number / camera.fps
        if self.moving:
            color, depth = spoil.with_moving_objects(color, depth, self.moving, at_s, self._rng(ALL, 0))
        if self.reflecting:
            color, depth = spoil.with_reflections(color, depth, self.reflecting, self._rng(ALL, 1))
        if (self.exposure_ms or self.readout_ms) and (flow := self._flow(number, frame)) is not None:
            period_ms = 1e3 / camera.fps
            color = spoil.add_motion_blur(color, flow, self.exposure_ms / period_ms) if self.exposure_ms else color
            color, depth = spoil.add_rolling_shutter(color, depth, flow, self.readout_ms / period_ms) if self.readout_ms else (color, depth)
        if self.shuffle and (other := self._inner(int(self._rng(SHUFFLED, number).integers(len(self._inner))))) is not None:
            color = other.color
        color = np.ascontiguousarray(color[:, ::-1]) if self.mirror else color
        color = spoil.with_gamma(color, self.gamma) if self.gamma != 1.0 else color
        color = spoil.with_color_noise(color, self.color_noise, self._rng(GRAIN, number)) if self.color_noise else color
        if self.resize != 1.0:
            color, depth, camera = spoil.resize_frame(color, depth, camera, self.resize)
        if self.depth_resize != 1.0:
            _refuse_sizes(number, depth, self.depth_resize)
        return color, self._wrong_depth(depth, camera, rng), replace(camera, fx=camera.fx * self.focal_times, fy=camera.fy * self.focal_times)

    def _wrong_depth(self, depth: F32, camera: Camera, rng: np.random.Generator) -> F32:
        steps: list[tuple[float, Callable[[F32], F32]]] = [
            (self.depth_noise, lambda z: spoil.noisy(z, self.depth_noise, camera, rng)),
            (self.depth_holes, lambda z: spoil.with_holes(z, self.depth_holes, rng)),
            (self.depth_limit_m, lambda z: np.minimum(z, np.float32(self.depth_limit_m))),
            (self.depth_times != 1.0, lambda z: z * np.float32(self.depth_times)),
            (self.not_finite, lambda z: spoil.not_finite(z, self.not_finite, rng)),
        ]
        for wanted, step in steps:
            depth = step(depth) if wanted else depth
        return depth

    def _flow(self, number: int, frame: Frame) -> F32 | None:
        """(h, w, 2) pixels by which the image moves until the next frame, or did since the one before where there is no next."""
        later = number + 1 < len(self._inner)
        other: Frame | None = self._inner(number + (1 if later else -1)) if len(self._inner) > 1 else None
        if other is None:
            return None
        return spoil.flow_px(frame.gray, other.gray) * np.float32(1.0 if later else -1.0)

    def _rng(self, stream: int, number: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, stream, number])

    @cached_property
    def _delivery(self) -> Delivery:
        return Delivery(self.drop, self.drop_share, self.every, self.freeze, self.reverse, self.jump, self.jump_s)

    @cached_property
    def _delivered_frames(self) -> Any:
        return self._delivery.frame_numbers(len(self._inner), self.seed)

    @cached_property
    def _range(self) -> range:
        return clip_range(self.frames, len(self._delivered_frames), f"the {self.of} data set, as far as they are delivered")

    @cached_property
    def _inner(self) -> Any:
        first = self._underneath(self.options)
        return Joined(first, self.join, self._underneath({**self.options, **self.joined})) if self.join else first

    def _underneath(self, options: dict[str, Any]) -> Any:
        kind = plugin_class("dataset", self.of)
        known = [option.name for option in fields(kind)]
        if (unknown := next((name for name in options if name not in known), None)) is not None:
            raise ValueError(f"options: {self.of} has no option '{unknown}'; {did_you_mean(unknown, known)}")
        return kind(**options)


def _refuse_sizes(number: int, depth: F32, times: float) -> None:
    h, w = depth.shape
    cause = f"depth is {round(times * w)}×{round(times * h)} while colour is {w}×{h}"
    raise DataError(f"frame {number}", cause, "register depth to colour first")
