"""Terms for the pose solver from features and the landmarks they were matched to."""

from __future__ import annotations

import math

import numpy as np

from trihedron.pipeline.core.types import F64, I32, Camera, Keypoints, Map, Planes, Segments
from trihedron.plugins.mapping.reprojection_kernels import line_terms_kernel, plane_terms_kernel, point_terms_kernel
from trihedron.plugins.shared.pose_optimizer_kernels import LineTerms, PlaneTerms, PointTerms


def point_terms(map: Map, keypoints: Keypoints, pairs: I32) -> PointTerms:
    """Key points (rows `pairs[:, 0]`) and their landmarks (ids `pairs[:, 1]`)."""
    rows = pairs[:, 0].copy()
    positions_m, information = map.points.gathered(pairs[:, 1], "position_m", "information")
    return point_terms_kernel(positions_m, information, rows, keypoints.pixels, keypoints.points_m, keypoints.sigma_px, keypoints.sigma_m)


def line_terms(map: Map, segments: Segments, pairs: I32, T_world_camera: F64, camera: Camera, sigma_px: float) -> LineTerms:
    """Segments and their map lines, each line given by its points opposite the segment's ends: what lies beyond them was not seen."""
    rows = pairs[:, 0].copy()
    ends_m, information = map.lines.gathered(pairs[:, 1], "endpoints_m", "information")
    seen_px, seen_m, noise = segments.endpoints_px, segments.endpoints_m, segments.covariance_m2
    return line_terms_kernel(ends_m, information, rows, seen_px, seen_m, noise, T_world_camera.copy(), camera.intrinsics, sigma_px)


def points_along(endpoints: F64, covariance: F64, share: F64) -> tuple[F64, F64]:
    """Points (n, 2, 3) at the shares (n, 2) of lines (n, 2, 3), and their covariances (n, 2, 3, 3)."""
    s = share[..., None]
    points = (1.0 - s) * endpoints[:, :1] + s * endpoints[:, 1:]
    s = s[..., None]
    return points, (1.0 - s) ** 2 * covariance[:, :1] + s * s * covariance[:, 1:]


def plane_terms(map: Map, planes: Planes, same: I32, parallel: I32, perpendicular: I32, relation_sigma_deg: float) -> PlaneTerms:
    """Observed planes against the same, parallel and perpendicular map planes; walls are parallel to within `relation_sigma_deg`.

    An observed normal that takes part in k relations has its covariance multiplied by k in each: it was measured once."""
    pairs = np.concatenate([same, parallel, perpendicular])
    coefficients, covariance = map.planes.gathered(pairs[:, 1], "coefficients", "covariance")
    extra = math.radians(relation_sigma_deg) ** 2
    rows = len(same), len(same) + len(parallel)
    kinds, observed, noise = plane_terms_kernel(covariance, pairs, *rows, planes.coefficients, planes.covariance, extra)
    return PlaneTerms(kinds, coefficients, covariance, observed, noise)
