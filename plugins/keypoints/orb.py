"""ORB key points spread over the image, with depth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated

import cv2
import numpy as np

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveInt, Range, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, U8, Frame, Keypoints
from trihedron.plugins.keypoints.lifting import LiftOptions, lift_keypoints
from trihedron.plugins.keypoints.orb_kernels import BITS, REACH_PX, Pyramid, full_pixels, oriented_corners, steered_brief

MARGIN_PX = 19  # of a level, within which its descriptors would reach over the border


@register("keypoints", "orb")
@dataclass(frozen=True)
class Orb(LiftOptions):
    """Oriented FAST and rotated BRIEF (Rublee et al., ICCV 2011), chosen per grid cell so that a textured corner does not take them all."""

    features: PositiveInt = 1000  # most key points kept
    scale: Annotated[float, Range(above=1, high=2)] = 1.2  # between pyramid levels
    levels: Annotated[int, Range(1, 16)] = 8
    fast_threshold: Annotated[int, Range(1, 255)] = 20  # grey levels
    fast_threshold_low: Annotated[int, Range(1, 255)] = 7  # where a grid cell has few
    cell_px: Annotated[int, Range(4)] = 64  # side of the grid cells
    fineness: NonNegativeFloat = 2.0  # strengths are compared after division by the level's scale to this power: fine levels place points better

    def __post_init__(self) -> None:
        check_increasing(self, "fast_threshold_low", "fast_threshold")

    def __call__(self, frame: Frame) -> Keypoints:
        """At most `features` key points ordered by level, row and column; (n, 32) binary descriptors."""
        pyramid = image_pyramid(frame.gray, self.scale, self.levels, 2 * MARGIN_PX + 1)
        weights = np.asarray(self.scale ** (-self.fineness * np.arange(len(pyramid.shapes))), np.float64)
        thresholds = self.fast_threshold, self.fast_threshold_low
        cells, levels, angles = oriented_corners(pyramid, *thresholds, MARGIN_PX, self.cell_px, self.features, weights)
        descriptors = steered_brief(pyramid, cells, levels, angles, self._tests)
        pixels = full_pixels(cells, levels, pyramid.shapes).astype(np.float32)
        return lift_keypoints(self, frame, pixels, self.scale ** levels.astype(np.float64), levels.astype(np.uint8), angles, descriptors)

    @cached_property
    def _tests(self) -> F32:
        return brief_tests()


def image_pyramid(gray: U8, scale: float, levels: int, least_px: int) -> Pyramid:
    """The image (h, w) at 1, 1/scale, 1/scale² …: at most `levels`, none but the first with a side below `least_px`."""
    shapes = [gray.shape]
    for level in range(1, levels):
        shape = (round(gray.shape[0] / scale**level), round(gray.shape[1] / scale**level))
        if min(shape) < least_px:
            break
        shapes.append(shape)
    starts = np.concatenate([[0], np.cumsum([h * w for h, w in shapes])]).astype(np.int32)
    pyramid = Pyramid(np.empty(starts[-1], np.uint8), starts, np.array(shapes, np.int32))
    images = pyramid.images()
    images[0][:] = gray
    for above, image in pairwise(images):
        cv2.resize(above, image.shape[::-1], dst=image, interpolation=cv2.INTER_LINEAR_EXACT)
    return pyramid


LONGEST_PX = 9.0  # between a test's ends: as many bits differ between images of one place, and of two, as with tests that were learned


def brief_tests(seed: int = 0) -> F32:
    """(4, 256) ends (x1, y1, x2, y2) in px about the key point: drawn evenly from the disc, not further apart than `LONGEST_PX`."""
    rng = np.random.default_rng(seed)
    tests: list[F32] = []
    while len(tests) < BITS:
        x1, y1, x2, y2 = np.round(rng.uniform(-REACH_PX, REACH_PX, 4))
        if max(np.hypot(x1, y1), np.hypot(x2, y2)) <= REACH_PX and 1.0 <= np.hypot(x1 - x2, y1 - y2) <= LONGEST_PX:
            tests.append(np.array([x1, y1, x2, y2], np.float32))
    return np.stack(tests, axis=1)
