"""Kernels of `projection.py`: visibility of points, clipping of lines, and the terms of points, lines and planes for the pose optimiser."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool
from trihedron.plugins.shared.linalg_kernels import invert_symmetric
from trihedron.plugins.shared.pose_optimizer_kernels import PARALLEL, PERPENDICULAR, SAME, LineTerms, PointTerms

NEAR_M = 0.1
MAX_SCALE_CHANGE = 2.0  # of the distance; beyond, a point does not look the same
EXTEND = 0.25  # a line's map end points may be moved outwards by this share of its length


@kernel
def visible_points_kernel(
    points: F64, directions: F32, distances: F32, octaves: U8, T_world_camera: F64, intrinsics: tuple[float, float, float, float, int, int],
    cosine: float, log_scale: float,
) -> tuple[I32, F32, F64, U8]:  # fmt: skip
    """Return the fields of `VisiblePoints`."""
    fx, fy, cx, cy, width, height = intrinsics
    rows, n = np.empty(len(points), np.int32), 0
    pixels, depth, levels = np.empty((len(points), 2), np.float32), np.empty(len(points)), np.empty(len(points), np.uint8)
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    for i in range(len(points)):
        x, y, z = points[i, 0] - t[0], points[i, 1] - t[1], points[i, 2] - t[2]
        away = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
        if not away > NEAR_M:
            continue
        u = fx * (R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) / away + cx
        v = fy * (R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) / away + cy
        if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            continue
        distance = np.sqrt(x * x + y * y + z * z)
        change = distances[i] / distance
        facing = -(x * directions[i, 0] + y * directions[i, 1] + z * directions[i, 2])
        if facing > cosine * distance and 1.0 / MAX_SCALE_CHANGE < change < MAX_SCALE_CHANGE:
            rows[n], pixels[n, 0], pixels[n, 1], depth[n] = i, u, v, away
            levels[n] = min(max(np.rint(octaves[i] + np.log(change) / log_scale), 0.0), 255.0)
            n += 1
    return rows[:n], pixels[:n], depth[:n], levels[:n]


@kernel
def clip_segments_kernel(world: F64, T: F64, intrinsics: tuple[float, float, float, float, int, int]) -> tuple[F64, Bool]:
    """Project and clip segments; see `clip_segments`."""
    fx, fy, cx, cy, width, height = intrinsics
    pixels, left, local = np.empty((len(world), 2, 2)), np.zeros(len(world), np.bool_), np.empty((2, 3))
    for i in range(len(world)):
        for k in range(2):
            for a in range(3):
                local[k, a] = T[a, 0] * world[i, k, 0] + T[a, 1] * world[i, k, 1] + T[a, 2] * world[i, k, 2] + T[a, 3]
        start, end = local[0, 2], local[1, 2]
        cut = (NEAR_M - start) / (1e-9 if abs(end - start) < 1e-9 else end - start)
        for k in range(2):
            x, y, z = local[k, 0], local[k, 1], local[k, 2]
            if z < NEAR_M:
                x = local[0, 0] + cut * (local[1, 0] - local[0, 0])
                y = local[0, 1] + cut * (local[1, 1] - local[0, 1])
                z = start + cut * (end - start)
            pixels[i, k, 0], pixels[i, k, 1] = fx * x / z + cx, fy * y / z + cy
        low, high = 0.0, 1.0
        for axis, size in ((0, width), (1, height)):
            p = pixels[i, 0, axis]
            delta = pixels[i, 1, axis] - p
            if abs(delta) < 1e-9:
                delta = 1e-9
            first, last = (-0.5 - p) / delta, (size - 0.5 - p) / delta
            low, high = max(low, min(first, last)), min(high, max(first, last))
        u, v = pixels[i, 0, 0], pixels[i, 0, 1]
        du, dv = pixels[i, 1, 0] - u, pixels[i, 1, 1] - v
        pixels[i, 0, 0], pixels[i, 0, 1] = u + low * du, v + low * dv
        pixels[i, 1, 0], pixels[i, 1, 1] = u + high * du, v + high * dv
        left[i] = (start >= NEAR_M or end >= NEAR_M) and (high - low) * np.sqrt(du * du + dv * dv) > 1.0
    return pixels, left


@kernel
def point_terms_kernel(positions_m: F64, information: F32, rows: I32, pixels: F32, points_m: F32, sigmas_px: F32, sigmas_m: F32) -> PointTerms:
    """Gather the terms of key points and landmarks; see `point_terms`."""
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
    """Gather the terms of segments and map lines; see `line_terms`."""
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
    """Parameter along a world line (2, 3; 0 = start, 1 = end) of its point nearest to the ray through a pixel, from the camera's pose T (4, 4).

    With d along the line and r the ray, `r × (d × r) = d (r·r) - r (r·d)` is normal to the ray in the plane it spans with the line."""
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
    """Gather kinds, observed planes and their covariances of pairs (p, 2): the same planes, from row `parallel` on parallel and from `perpendicular`
    on perpendicular ones, to whose map covariances (p, 3, 3) `extra` (rad²) is added."""
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
