"""Kernels of the landmark map, in the order of a frame: visibility and clipping (projection), pairs (data association), terms of the pose optimiser,
information filters of points and lines (insertion), samples of planes (insertion, merging), and redundancy of keyframes (culling)."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import invert_small, invert_symmetric
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool
from trihedron.plugins.shared.residuals_kernels import (
    NEAR_M,
    PARALLEL,
    PERPENDICULAR,
    SAME,
    LineTerms,
    PointTerms,
    depth_direction,
    line_depth_residual,
    line_residual,
    point_residual,
    pose_jacobian,
    to_camera,
)

MIN_DEPTH_M = 0.1  # of a visible landmark
MAX_SCALE_CHANGE = 2.0  # of the distance; beyond, a point does not look the same
EXTEND = 0.25  # a line's map end points may be moved outwards by this share of its length
FARTHER = 1.2  # a landmark observed from at most this many times as far is observed as well: a level of the key points' pyramid

# Visibility.


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
        if not away > MIN_DEPTH_M:
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
        cut = (MIN_DEPTH_M - start) / (1e-9 if abs(end - start) < 1e-9 else end - start)
        for k in range(2):
            x, y, z = local[k, 0], local[k, 1], local[k, 2]
            if z < MIN_DEPTH_M:
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
        left[i] = (start >= MIN_DEPTH_M or end >= MIN_DEPTH_M) and (high - low) * np.sqrt(du * du + dv * dv) > 1.0
    return pixels, left


# Pairs.


@kernel
def related_planes(
    planes: F64, known: F64, same: I32, order: NDArray[np.int64], ids: I32, parallel_above: float, perpendicular_below: float, most: int
) -> tuple[I32, I32]:
    """Pair (row, id) each plane with up to `most` known ones, first in order, that are parallel to it, and perpendicular, without the same plane."""
    n, one = len(planes), np.full(len(planes), -1, np.int32)
    parallel, perpendicular = np.empty((n * most, 2), np.int32), np.empty((n * most, 2), np.int32)
    p, q = 0, 0
    for k in range(len(same)):
        one[same[k, 0]] = same[k, 1]
    for i in range(n):
        p_end, q_end = p + most, q + most
        for j in order:
            cosine = abs(planes[i, 0] * known[j, 0] + planes[i, 1] * known[j, 1] + planes[i, 2] * known[j, 2])
            if j == one[i]:
                continue
            if cosine > parallel_above and p < p_end:
                parallel[p, 0], parallel[p, 1] = i, ids[j]
                p += 1
            if cosine < perpendicular_below and q < q_end:
                perpendicular[q, 0], perpendicular[q, 1] = i, ids[j]
                q += 1
    return parallel[:p], perpendicular[:q]


@kernel(nogil=False)
def pairs_by_row(found: I32, ids: I32, count: int) -> I32:
    """Sort the rows found for landmarks (-1 = none; of `count` rows, none for two) into pairs (row, id), (n, 2), by row."""
    owner, pairs, n = np.full(count, -1, np.int32), np.empty((len(found), 2), np.int32), 0
    for i in range(len(found)):
        if found[i] >= 0:
            owner[found[i]] = ids[i]
    for row in range(count):
        if owner[row] >= 0:
            pairs[n, 0], pairs[n, 1] = row, owner[row]
            n += 1
    return pairs[:n]


# Terms of the pose optimiser.


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


# Information filters: a keyframe's observations update point and line landmarks.


@kernel
def _pose_noise(D: F64, p: F64, pose_covariance: F64, rows: int, J: F64, S: F64) -> None:
    """Fill S with the covariance that the pose adds to residuals with Jacobian D (rows, 3) by the camera-frame point p."""
    pose_jacobian(D, rows, p, J)
    for a in range(rows):
        for b in range(rows):
            S[a, b] = 0.0
            for i in range(6):
                for j in range(6):
                    S[a, b] += J[a, i] * pose_covariance[i, j] * J[b, j]


@kernel
def _update(position: F64, information: F64, R: F64, D: F64, r: F64, S: F64, rows: int) -> None:
    """Update a landmark in place by one Gauss–Newton step on r (rows,), with Jacobian D by the camera-frame point and covariance S."""
    W, C, E, g = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    invert_small(S, rows, W)
    for k in range(rows):
        for j in range(3):
            E[k, j] = D[k, 0] * R[j, 0] + D[k, 1] * R[j, 1] + D[k, 2] * R[j, 2]
    for a in range(rows):
        for b in range(rows):
            for i in range(3):
                g[i] += E[a, i] * W[a, b] * r[b]
                for j in range(3):
                    information[i, j] += E[a, i] * W[a, b] * E[b, j]
    invert_small(information, len(information), C)
    for i in range(3):
        position[i] -= C[i, 0] * g[0] + C[i, 1] * g[1] + C[i, 2] * g[2]


@kernel
def _fade_across(information: F64, ends: F64, share: float) -> None:
    """Multiply the information (3, 3) of a line's end by `share` across the line, in place. Along it, where segments measure nothing, it stays: it
    would otherwise vanish beside the rest, and rounding would give the matrix a negative eigenvalue."""
    length, u, row, along, root = 0.0, np.empty(3), np.empty(3), 0.0, np.sqrt(share)
    for k in range(3):
        u[k] = ends[1, k] - ends[0, k]
        length += u[k] * u[k]
    length = max(np.sqrt(length), 1e-12)
    for k in range(3):
        u[k] /= length
    for i in range(3):
        row[i] = information[i, 0] * u[0] + information[i, 1] * u[1] + information[i, 2] * u[2]
        along += u[i] * row[i]
    for i in range(3):  # S information S with S = root · 1 + (1 - root) u uᵀ
        for j in range(3):
            mixed = root * (1.0 - root) * (row[i] * u[j] + u[i] * row[j]) + (1.0 - root) ** 2 * along * u[i] * u[j]
            information[i, j] = share * information[i, j] + mixed


@kernel
def fuse_points(
    T_world_camera: F64,
    pose_covariance: F64,
    camera: F64,
    positions: F64,
    information: F64,
    pixels: F64,
    depth_m: F64,
    sigma_px: F64,
    sigma_m: F64,
    memory: float,
) -> None:
    """Update positions (n, 3) and information (n, 3, 3), in place, by pixels (n, 2) and depths (n,; NaN = none) measured from an uncertain pose.

    The old information is first multiplied by `1 - 1/memory`: it stays that of at most `memory` measurements, so that a landmark can still move."""
    R, t = T_world_camera[:3, :3].copy(), T_world_camera[:3, 3].copy()
    p, r, D, J, S = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 6)), np.empty((3, 3))
    for i in range(len(positions)):
        to_camera(R, t, positions[i], p)
        if not point_residual(p, pixels[i], depth_m[i], camera, r, D):
            continue
        rows = 3 if np.isfinite(depth_m[i]) else 2
        _pose_noise(D, p, pose_covariance, 3, J, S)
        S[0, 0] += sigma_px[i] ** 2
        S[1, 1] += sigma_px[i] ** 2
        if rows == 3:
            S[2, 2] += (sigma_m[i] / depth_m[i] ** 2) ** 2
        for a in range(3):
            for b in range(3):
                information[i, a, b] *= 1.0 - 1.0 / memory
        _update(positions[i], information[i], R, D, r, S, rows)


@kernel
def fuse_lines(
    T_world_camera: F64,
    pose_covariance: F64,
    camera: F64,
    endpoints: F64,
    information: F64,
    endpoints_px: F64,
    observed_m: F64,
    observed_covariance: F64,
    sigma_px: float,
    memory: float,
) -> None:
    """Update both ends (n, 2, 3) of lines and their information (n, 2, 3, 3), in place, across the line only: in the image by the distance from the
    segment seen, in depth by that from its 3D line where it has one (NaN = none)."""
    R, t = T_world_camera[:3, :3].copy(), T_world_camera[:3, 3].copy()
    p, r, D, J, m, S = np.empty(3), np.empty(2), np.empty((2, 3)), np.empty((2, 6)), np.empty(3), np.empty((2, 2))
    ends = np.empty(2)
    for i in range(len(endpoints)):
        deep = depth_direction(observed_m[i], m)
        for k in range(2):
            ends[k] = 0.0
            for a in range(3):
                for b in range(3):
                    ends[k] += m[a] * observed_covariance[i, k, a, b] * m[b]
        for k in range(2):
            to_camera(R, t, endpoints[i, k], p)
            if not p[2] > NEAR_M:
                continue
            rows, r[1], D[1, 0], D[1, 1], D[1, 2] = 1, 0.0, 0.0, 0.0, 0.0
            r[0], s = line_residual(p, endpoints_px[i], camera, D[0])
            noise = sigma_px**2 * ((1.0 - s) ** 2 + s * s)
            if deep:
                rows = 2
                r[1], s = line_depth_residual(p, observed_m[i], m)
                D[1, 0], D[1, 1], D[1, 2] = m[0], m[1], m[2]
            _pose_noise(D, p, pose_covariance, rows, J, S)
            S[0, 0] += noise
            if deep:
                S[1, 1] += (1.0 - s) ** 2 * ends[0] + s * s * ends[1]
            _fade_across(information[i, k], endpoints[i], 1.0 - 1.0 / memory)
            _update(endpoints[i, k], information[i, k], R, D, r, S, rows)


# Samples of planes.


@kernel
def farthest_samples(points: F32, count: int) -> F32:
    """Select up to `count` finite rows of points (n, 3), each the farthest from those before it; NaN-padded (count, 3)."""
    out = np.full((count, 3), np.nan, np.float32)
    n = 0
    kept = np.empty((len(points), 3), np.float32)
    for i in range(len(points)):
        if np.isfinite(points[i, 0]):
            kept[n, 0], kept[n, 1], kept[n, 2] = points[i, 0], points[i, 1], points[i, 2]
            n += 1
    distance = np.full(n, np.inf)
    chosen = 0
    for k in range(min(n, count)):
        x, y, z = kept[chosen, 0], kept[chosen, 1], kept[chosen, 2]
        out[k, 0], out[k, 1], out[k, 2] = x, y, z
        farthest = -1.0
        for i in range(n):
            distance[i] = min(distance[i], (kept[i, 0] - x) ** 2 + (kept[i, 1] - y) ** 2 + (kept[i, 2] - z) ** 2)
            if distance[i] > farthest:
                farthest, chosen = distance[i], i
    return out


# Redundancy of keyframes.


@kernel
def count_redundant(
    observed: I32, ends: NDArray[np.int64], keyframes: I32, observers: I32, centres: F64, rows: I32, poses: F64, alive: Bool, others: int
) -> NDArray[np.int64]:
    """Count the landmarks of each keyframe, and those of them that at least `others` further living keyframes observed from as near: (2, n).

    `observed` are the landmarks of each keyframe in turn up to its end, -1 = not counted; `observers` (m, OBSERVERS) and `centres` (m, 3) are those
    of the landmarks; `poses` (k, 4, 4) and `alive` (k,) those of the keyframes `rows`, sorted, which include all observers."""
    place, counts = np.empty(rows[-1] + 1, np.int32), np.zeros((2, len(keyframes)), np.int64)
    for k in range(len(rows)):
        place[rows[k]] = k
    counted, begin = np.full(len(centres), -1), 0  # the last keyframe that a landmark was counted for
    for k in range(len(keyframes)):
        for o in range(begin, ends[k]):
            i = observed[o]
            if i < 0 or counted[i] == k:
                continue
            counted[i] = k
            reach, count = FARTHER * _distance(poses[place[keyframes[k]]], centres[i]), 0
            for row in observers[i]:
                if row >= 0 and row != keyframes[k] and alive[place[row]]:
                    count += _distance(poses[place[row]], centres[i]) <= reach
            counts[0, k] += 1
            counts[1, k] += count >= others
        begin = ends[k]
    return counts


@kernel
def _distance(T: F64, p: F64) -> float:
    """Distance of a point from a camera."""
    x, y, z = T[0, 3] - p[0], T[1, 3] - p[1], T[2, 3] - p[2]
    return np.sqrt(x * x + y * y + z * z)
