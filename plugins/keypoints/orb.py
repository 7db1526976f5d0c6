"""ORB key points spread over the image, with depth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F32, U8, Frame, Keypoints
from trihedron.plugins.keypoints.orb_kernels import BITS, REACH_PX, Pyramid, full_pixels, oriented_corners, steered_brief
from trihedron.plugins.shared.depth_image import noise_coefficients
from trihedron.plugins.shared.depth_image_kernels import local_depth

MARGIN_PX = 19  # of a level, within which its descriptors would reach over the border


@register("keypoints", "orb")
@dataclass(frozen=True)
class Orb:
    """Oriented FAST and rotated BRIEF (Rublee et al., ICCV 2011), chosen per grid cell so that a textured corner does not take them all."""

    features: int = 1000  # most key points kept
    scale: float = 1.2  # between pyramid levels
    levels: int = 8
    fast_threshold: int = 20  # grey levels
    fast_threshold_low: int = 7  # where a grid cell has few
    cell_px: int = 64  # side of the grid cells
    fineness: float = 2.0  # strengths are compared after division by the level's scale to this power: fine levels place points better
    sigma_px: float = 0.6  # of a position at level 0; grows with the level's scale
    depth_radius_px: int = 2  # of the neighbourhood the depth is taken from
    depth_share: float = 0.5  # of the neighbourhood that must have depth
    depth_gate: float = 3.0  # σ_z a neighbourhood may spread about a linear surface
    depth_edge: float = 0.01  # more than that, as a share of z, is a depth edge: no depth

    def __post_init__(self) -> None:
        if self.features < 1:
            raise ValueError("features: must be at least 1")
        if not 1.0 < self.scale <= 2.0:
            raise ValueError("scale: must be in (1, 2]")
        if not 1 <= self.levels <= 16:
            raise ValueError("levels: must be 1 to 16")
        if not 1 <= self.fast_threshold_low <= self.fast_threshold <= 255:
            raise ValueError("fast_threshold, fast_threshold_low: must be 1 to 255, the low one not above the other")
        if self.cell_px < 4 or self.sigma_px <= 0.0 or self.fineness < 0.0:
            raise ValueError("cell_px, sigma_px, fineness: must be at least 4, above 0 and not negative")
        if not 1 <= self.depth_radius_px <= 10 or not 0.0 < self.depth_share <= 1.0 or self.depth_gate <= 0.0 or self.depth_edge < 0.0:
            raise ValueError("depth_radius_px, depth_share, depth_gate, depth_edge: out of range")

    def __call__(self, frame: Frame) -> Keypoints:
        """At most `features` key points ordered by level, row and column; (n, 32) binary descriptors."""
        pyramid = image_pyramid(frame.gray, self.scale, self.levels, 2 * MARGIN_PX + 1)
        weights = np.asarray(self.scale ** (-self.fineness * np.arange(len(pyramid.shapes))), np.float64)
        thresholds = self.fast_threshold, self.fast_threshold_low
        cells, levels, angles = oriented_corners(pyramid, *thresholds, MARGIN_PX, self.cell_px, self.features, weights)
        descriptors = steered_brief(pyramid, cells, levels, angles, self._tests)
        pixels = full_pixels(cells, levels, pyramid.shapes).astype(np.float32)
        noise = noise_coefficients(frame.camera.depth_noise)
        depth, sigma = local_depth(frame.depth_m, pixels, self.depth_radius_px, self.depth_share, noise, self.depth_gate, self.depth_edge)
        return Keypoints(
            index=frame.index,
            stamp_ns=frame.stamp_ns,
            pixels=pixels,
            points_m=frame.camera.back_project(pixels, depth).astype(np.float32),
            sigma_px=(self.sigma_px * self.scale**levels).astype(np.float32),
            sigma_m=sigma,
            octaves=levels.astype(np.uint8),
            angles_deg=angles,
            descriptors=descriptors,
        )

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
