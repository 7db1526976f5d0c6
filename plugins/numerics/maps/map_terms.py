"""Terms for the pose solver from features and the landmarks they were matched to."""

from __future__ import annotations

import math

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, Camera, Keypoints, Map, Planes, Segments
from trihedron.plugins.numerics.algebra.small_linear import invert_symmetric
from trihedron.plugins.numerics.motion.pose_terms import PARALLEL, PERPENDICULAR, SAME, LineTerms, PlaneTerms, PointTerms

EXTEND = 0.25  # a line's map end points may be moved outwards by this share of its length


def point_terms(map: Map, keypoints: Keypoints, pairs: I32) -> PointTerms:
    """Key points (rows `pairs[:, 0]`) and their landmarks (ids `pairs[:, 1]`)."""
    rows = pairs[:, 0].copy()
    positions_m, information = map.points.gathered(pairs[:, 1], "position_m", "information")
    return _point_terms(positions_m, information, rows, keypoints.pixels, keypoints.points_m, keypoints.sigma_px, keypoints.sigma_m)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _point_terms(positions_m: F64, information: F32, rows: I32, pixels: F32, points_m: F32, sigmas_px: F32, sigmas_m: F32) -> PointTerms:
    n = len(rows)
    covariance, seen, depth_m, sigma_px, sigma_m = np.empty((n, 3, 3)), np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        row = rows[i]
        invert_symmetric(information[i], covariance[i])
        seen[i, 0], seen[i, 1] = pixels[row, 0], pixels[row, 1]
        depth_m[i], sigma_px[i], sigma_m[i] = points_m[row, 2], sigmas_px[row], sigmas_m[row]
    return PointTerms(positions_m, covariance, seen, depth_m, sigma_px, sigma_m)


def line_terms(map: Map, segments: Segments, pairs: I32, T_world_camera: F64, camera: Camera, sigma_px: float) -> LineTerms:
    """Segments and their map lines, each line given by its points opposite the segment's ends: what lies beyond them was not seen."""
    rows = pairs[:, 0].copy()
    ends_m, information = map.lines.gathered(pairs[:, 1], "endpoints_m", "information")
    seen_px, seen_m, noise = segments.endpoints_px, segments.endpoints_m, segments.covariance_m2
    return _line_terms(ends_m, information, rows, seen_px, seen_m, noise, T_world_camera.copy(), camera.intrinsics, sigma_px)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _line_terms(
    endpoints_m: F64, information: F32, rows: I32, ends_px: F32, ends_m: F32, covariances_m2: F32, T: F64, camera: F64, sigma_px: float
) -> LineTerms:
    m = len(rows)
    points, covariance, known = np.empty((m, 2, 3)), np.empty((m, 2, 3, 3)), np.empty((2, 3, 3))
    seen_px, sigmas_px, seen_m, noise = np.empty((m, 2, 2)), np.empty(m), np.empty((m, 2, 3)), np.empty((m, 2, 3, 3))
    for i in range(m):
        row = rows[i]
        sigmas_px[i] = sigma_px
        for k in range(2):
            invert_symmetric(information[i, k], known[k])
        for k in range(2):
            seen_px[i, k, 0], seen_px[i, k, 1] = ends_px[row, k, 0], ends_px[row, k, 1]
            s = _share_opposite(endpoints_m[i], seen_px[i, k], T, camera)
            for a in range(3):
                points[i, k, a] = (1.0 - s) * endpoints_m[i, 0, a] + s * endpoints_m[i, 1, a]
                seen_m[i, k, a] = ends_m[row, k, a]
                for b in range(3):
                    covariance[i, k, a, b] = (1.0 - s) ** 2 * known[0, a, b] + s * s * known[1, a, b]
                    noise[i, k, a, b] = covariances_m2[row, k, a, b]
    return LineTerms(points, covariance, seen_px, sigmas_px, seen_m, noise)


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _share_opposite(line_m: F64, pixel: F64, T: F64, camera: F64) -> float:
    """Where along a world line (2, 3; 0 = start, 1 = end) lies the point nearest to the ray through a pixel, from the camera's pose T (4, 4). With d
    along the line and r the ray, `r × (d × r) = d (r·r) - r (r·d)` is normal to the ray in the plane it spans with the line."""
    u, v = (pixel[0] - camera[2]) / camera[0], (pixel[1] - camera[3]) / camera[1]
    rr, rd, dd, rs, ds = 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        r, d, s = T[a, 0] * u + T[a, 1] * v + T[a, 2], line_m[1, a] - line_m[0, a], line_m[0, a] - T[a, 3]
        rr, rd, dd, rs, ds = rr + r * r, rd + r * d, dd + d * d, rs + r * s, ds + d * s
    along = dd * rr - rd * rd
    share = 0.0 if along < 1e-12 else -(ds * rr - rs * rd) / along  # 0 for a line seen end on
    return min(max(share, -EXTEND), 1.0 + EXTEND)


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
    kinds, observed, noise = _plane_terms(covariance, pairs, len(same), len(same) + len(parallel), planes.coefficients, planes.covariance, extra)
    return PlaneTerms(kinds, coefficients, covariance, observed, noise)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _plane_terms(
    covariance: F64, pairs: I32, parallel: int, perpendicular: int, coefficients: F64, noise: F64, extra: float
) -> tuple[I32, F64, F64]:
    """Kinds, observed planes and their covariances of pairs (p, 2), the first the same, then from `parallel` and from `perpendicular` on walls that
    are related, to whose map covariances (p, 3, 3) `extra` (rad²) is added."""
    n = len(pairs)
    kinds, observed, of_observed, uses = np.full(n, SAME, np.int32), np.empty((n, 4)), np.empty((n, 3, 3)), np.zeros(len(coefficients))
    for i in range(parallel, n):
        kinds[i] = PARALLEL if i < perpendicular else PERPENDICULAR
        uses[pairs[i, 0]] += 1.0
        covariance[i, 0, 0] += extra
        covariance[i, 1, 1] += extra
    for i in range(n):
        row = pairs[i, 0]
        for a in range(4):
            observed[i, a] = coefficients[row, a]
        for a in range(3):
            for b in range(3):
                of_observed[i, a, b] = noise[row, a, b] * (uses[row] if i >= parallel else 1.0)
    return kinds, observed, of_observed
