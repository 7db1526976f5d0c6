"""Numba kernels of `reprojection.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32
from trihedron.plugins.shared.linalg_kernels import invert_symmetric
from trihedron.plugins.shared.pose_optimizer_kernels import PARALLEL, PERPENDICULAR, SAME, LineTerms, PointTerms

EXTEND = 0.25  # a line's map end points may be moved outwards by this share of its length


@kernel
def point_terms_kernel(positions_m: F64, information: F32, rows: I32, pixels: F32, points_m: F32, sigmas_px: F32, sigmas_m: F32) -> PointTerms:
    n = len(rows)
    covariance, seen, depth_m, sigma_px, sigma_m = np.empty((n, 3, 3)), np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        row = rows[i]
        invert_symmetric(information[i], covariance[i])
        seen[i, 0], seen[i, 1] = pixels[row, 0], pixels[row, 1]
        depth_m[i], sigma_px[i], sigma_m[i] = points_m[row, 2], sigmas_px[row], sigmas_m[row]
    return PointTerms(positions_m, covariance, seen, depth_m, sigma_px, sigma_m)


@kernel
def line_terms_kernel(
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


@kernel(forceinline=True)
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


@kernel
def plane_terms_kernel(
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
