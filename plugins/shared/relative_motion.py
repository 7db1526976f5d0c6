"""Motion between two frames from matched points, lines and planes with 3D positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.types import F64, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.shared.relative_motion_kernels import LinePairs, PlanePairs, PointPairs, estimate_motion


def pairs_of(tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes) -> tuple[PointPairs, LinePairs, PlanePairs]:
    """Pair the tracked features of the previous frame with the current features."""
    return (
        PointPairs(tracks.keypoints, tracks.points_m, tracks.sigma_m, keypoints.points_m, keypoints.sigma_px, keypoints.sigma_m),
        LinePairs(tracks.segments, tracks.endpoints_m, segments.endpoints_m, segments.covariance_m2),
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


def solve_motion(
    tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes, rad_per_px: float, floor_deg: float, sigma_deg: float, sigma_m: float
) -> Motion:
    """Estimate the motion that most tracks agree on, with priors on their predicted rotation (`sigma_deg`) and on no translation (`sigma_m`).

    `rad_per_px` converts sigma_px to an angle; `floor_deg` is the least σ of a plane's normal. Pairs that are not finite, or without covariance, are
    skipped. Graduated non-convexity (Yang et al., RA-L 2020): the Geman–McClure scale comes down from the median residual, so that up to half of the
    terms may be outliers. Never raises: without terms the prediction is returned, with the covariance of the prior."""
    noise = float(rad_per_px), float(np.radians(floor_deg)), float(np.radians(sigma_deg)), float(sigma_m)
    return Motion(*estimate_motion(*pairs_of(tracks, keypoints, segments, planes), tracks.R_current_previous, noise))
