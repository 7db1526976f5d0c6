"""Terms for the pose solver from features and the landmarks they were matched to."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.types import F64, I32, Camera, Keypoints, Map, Planes, Segments
from trihedron.plugins.numerics.algebra.uncertainty import inverse
from trihedron.plugins.numerics.motion.pose_terms import PARALLEL, PERPENDICULAR, SAME, LineTerms, PlaneTerms, PointTerms

EXTEND = 0.25  # a line's map end points may be moved outwards by this share of its length


def point_terms(map: Map, keypoints: Keypoints, pairs: I32) -> PointTerms:
    """Key points (rows `pairs[:, 0]`) and their landmarks (ids `pairs[:, 1]`)."""
    rows, ids = pairs[:, 0], pairs[:, 1]
    positions, information = map.points.gathered(ids, "position_m", "information")
    return PointTerms(
        positions,
        inverse(information),
        keypoints.pixels[rows].astype(np.float64),
        keypoints.points_m[rows, 2].astype(np.float64),
        keypoints.sigma_px[rows].astype(np.float64),
        keypoints.sigma_m[rows].astype(np.float64),
    )


def line_terms(map: Map, segments: Segments, pairs: I32, T_world_camera: F64, camera: Camera, sigma_px: float) -> LineTerms:
    """Segments and their map lines, each line given by its points opposite the segment's ends: what lies beyond them was not seen."""
    rows, ids = pairs[:, 0], pairs[:, 1]
    endpoints, information = map.lines.gathered(ids, "endpoints_m", "information")
    observed_px = segments.endpoints_px[rows].astype(np.float64)
    share = points_opposite(endpoints, observed_px, T_world_camera, camera)
    return LineTerms(
        *points_along(endpoints, inverse(information), share),
        observed_px,
        np.full(len(rows), sigma_px),
        segments.endpoints_m[rows].astype(np.float64),
        segments.covariance_m2[rows].astype(np.float64),
    )


def points_opposite(endpoints_m: F64, endpoints_px: F64, T_world_camera: F64, camera: Camera) -> F64:
    """(n, 2) where along each world line (n, 2, 3; 0 = start, 1 = end) lies the point nearest to the ray through each end (n, 2, 2) of a segment."""
    ray = np.ones((*endpoints_px.shape[:2], 3))
    ray[..., 0] = (endpoints_px[..., 0] - camera.cx) / camera.fx
    ray[..., 1] = (endpoints_px[..., 1] - camera.cy) / camera.fy
    ray = ray @ T_world_camera[:3, :3].T
    line = (endpoints_m[:, 1] - endpoints_m[:, 0])[:, None]
    to_start = endpoints_m[:, :1] - T_world_camera[:3, 3]
    normal = np.cross(ray, np.cross(np.broadcast_to(line, ray.shape), ray))  # to the ray, in the plane it spans with the line
    along = (line * normal).sum(-1)
    share = -(to_start * normal).sum(-1) / np.where(along < 1e-12, np.inf, along)  # 0 for a line seen end on
    return np.clip(share, -EXTEND, 1.0 + EXTEND)


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
    kinds = np.repeat(np.array([SAME, PARALLEL, PERPENDICULAR], np.int32), [len(same), len(parallel), len(perpendicular)])
    covariance = map.planes.rows("covariance", pairs[:, 1])
    observed = planes.covariance[pairs[:, 0]]
    related = kinds != SAME
    uses = np.bincount(pairs[related, 0], minlength=len(planes.coefficients))
    observed[related] *= uses[pairs[related, 0], None, None]
    covariance[related, 0, 0] += np.radians(relation_sigma_deg) ** 2
    covariance[related, 1, 1] += np.radians(relation_sigma_deg) ** 2
    return PlaneTerms(kinds, map.planes.rows("coefficients", pairs[:, 1]), covariance, planes.coefficients[pairs[:, 0]], observed)
