"""Lift the key points of any detector to 3D: depth where it is reliable, sizes as levels of a pyramid of factor 1.2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, PositiveShare, Range
from trihedron.pipeline.core.types import EXACT_DEPTH, F32, F64, U8, Frame, Keypoints
from trihedron.plugins.shared.depth_image_kernels import local_depth
from trihedron.plugins.shared.edge_width import motion_blur_px

LEVEL_SCALE = 1.2  # between levels, as the map expects (`octave_scale`)


@dataclass(frozen=True)
class LiftOptions:
    """Options of the position and depth of key points."""

    sigma_px: PositiveFloat = 0.6  # of a position at level 0; grows with the level's scale, or the key point's size
    depth_radius_px: Annotated[int, Range(1, 10)] = 2  # of the neighbourhood the depth is taken from
    depth_share: PositiveShare = 0.5  # of the neighbourhood that must have depth
    depth_gate: PositiveFloat = 3.0  # σ_z a neighbourhood may spread about a linear surface
    depth_edge: NonNegativeFloat = 0.01  # more than that, as a share of z, is a depth edge: no depth


def lift_pixels(options: LiftOptions, frame: Frame, pixels: F32) -> tuple[F32, F32]:
    """Return the points (n, 3) at pixels (n, 2), NaN without reliable depth, and the standard deviation (n,) of their depth."""
    noise = frame.camera.depth_noise.coefficients
    depth, sigma = local_depth(frame.depth_m, pixels, options.depth_radius_px, options.depth_share, noise, options.depth_gate, options.depth_edge)
    return frame.camera.back_project(pixels, depth).astype(np.float32), sigma


def lift_keypoints(
    options: LiftOptions, frame: Frame, pixels: F32, scales: F64, octaves: U8, angles_deg: F32, descriptors: U8, metric: str = "hamming"
) -> Keypoints:  # fmt: skip
    """Lift key points at pixels (n, 2) with scales (n,), 1 for the finest, octaves (n,), directions (n,) and descriptors (n, b); points are NaN
    without reliable depth. The noise of pixels grows with the scale and includes the blur of the image.

    Rendered depth is exact at every pixel, but a key point is off by a part of one, and so is its depth, on a surface that is seen at a slant: at 45°
    as far as the point is off across the ray."""
    points_m, sigma_m = lift_pixels(options, frame, pixels)
    blur_px = motion_blur_px(frame.gray)
    sigma_px = np.hypot(options.sigma_px * scales, blur_px)
    if frame.camera.depth_noise == EXACT_DEPTH:
        sigma_m = np.hypot(sigma_m, points_m[:, 2] * sigma_px / frame.camera.fx).astype(np.float32)
    return Keypoints(
        index=frame.index,
        stamp_ns=frame.stamp_ns,
        pixels=pixels,
        points_m=points_m,
        sigma_px=sigma_px.astype(np.float32),
        sigma_m=sigma_m,
        octaves=octaves,
        angles_deg=angles_deg,
        descriptors=descriptors,
        metric=metric,
        blur_px=blur_px,
    )


def detect_and_lift(options: LiftOptions, detector: Any, frame: Frame, smallest_px: float, width: int, metric: str, least_side: int) -> Keypoints:
    """Detect and describe key points by a detector of OpenCV, with descriptors of `width` bytes; a size of `smallest_px` is level 0. An image smaller
    than `least_side` has none."""
    small = min(frame.gray.shape) < least_side
    found, described = ((), None) if small else detector.detectAndCompute(frame.gray, None)
    rows = np.array([(*point.pt, point.size, point.angle) for point in found], np.float32).reshape(-1, 4)
    descriptors = np.zeros((0, width), np.uint8) if described is None or not len(found) else _bytes(described)
    scales = np.maximum(rows[:, 2].astype(np.float64) / smallest_px, 1.0)
    octaves = np.clip(np.rint(np.log(scales) / np.log(LEVEL_SCALE)), 0, 255).astype(np.uint8)
    return lift_keypoints(options, frame, rows[:, :2].copy(), scales, octaves, rows[:, 3].copy(), descriptors, metric)


def _bytes(descriptors: NDArray[Any]) -> U8:
    """Descriptors (n, b) as bytes: SIFT's are whole numbers from 0 to 255 already."""
    return np.ascontiguousarray(np.clip(np.rint(descriptors), 0, 255), np.uint8)
