"""Motion between two frames from matched points, lines and planes with 3D positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trihedron.pipeline.core.types import F64, Camera, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.shared.relative_motion_kernels import LinePairs, PlanePairs, PointPairs, estimate_motion


def pairs_of(tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes) -> tuple[PointPairs, LinePairs, PlanePairs]:
    """Pair the tracked features of the previous frame with the current features."""
    return (
        PointPairs(tracks.keypoints, tracks.points_m, tracks.sigma_m, keypoints.points_m, keypoints.pixels, keypoints.sigma_px, keypoints.sigma_m),
        LinePairs(tracks.segments, tracks.endpoints_m, segments.endpoints_m, segments.endpoints_px, segments.covariance_m2),
        PlanePairs(tracks.planes, tracks.coefficients, tracks.plane_covariance, planes.coefficients, planes.covariance),
    )


@dataclass(frozen=True)
class Motion:
    """`T_current_previous` as R (3, 3) and t (3,); covariance (6, 6) of (phi, rho), the prior's where nothing was measured;
    `support` is the sum of the robust weights, about the number of inliers."""

    R: F64
    t: F64
    covariance: F64
    support: float


class MotionOptions(Protocol):
    """Options of every plugin that estimates the motion between two frames from tracks."""

    @property
    def prior_deg(self) -> float:
        """Standard deviation of the predicted rotation, per frame."""

    @property
    def prior_m(self) -> float:
        """Standard deviation of the motion, per frame."""

    @property
    def angle_px(self) -> float:
        """Angle of a pixel, rad."""

    @property
    def plane_floor_deg(self) -> float:
        """Least error of a tracked plane's normal."""


def solve_motion(
    options: MotionOptions, camera: Camera, tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes, gap: int
) -> Motion:
    """Estimate the motion that most tracks agree on, with priors on their predicted rotation and on no translation over `gap` frames.

    Pairs that are not finite, or without covariance, are skipped. Graduated non-convexity (Yang et al., RA-L 2020): the Geman–McClure scale comes
    down from the median residual, so that up to half of the terms may be outliers. Never raises: without terms the prediction is returned, with the
    covariance of the prior."""
    floor, sigma, sigma_m = np.radians(options.plane_floor_deg), np.radians(options.prior_deg * gap), options.prior_m * gap
    noise = float(options.angle_px), float(floor), float(sigma), float(sigma_m)
    return Motion(*estimate_motion(*pairs_of(tracks, keypoints, segments, planes), camera.intrinsics, tracks.R_current_previous, noise))
