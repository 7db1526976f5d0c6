"""Pairs of places and of planes, one in each of two frames, with the information of their difference; places are points and the ends of lines."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, F64, I32, Keypoints, Planes, Segments, Tracks
from trihedron.plugins.numerics.algebra.small_linear import inverse_positive
from trihedron.plugins.numerics.motion.pose_terms import basis

SHORTEST_M = 1e-3  # line


class PointPairs(NamedTuple):
    """n points of the previous frame, and which of the current ones they are."""

    rows: I32  # (n, 2) previous, current
    before: F32  # (n, 3)
    before_sigma: F32  # (n,) of their depth
    points: F32  # (k, 3) current
    sigma_px: F32  # (k,) across the ray
    sigma_m: F32  # (k,) along it


class LinePairs(NamedTuple):
    """n lines of the previous frame, and which of the current ones they are."""

    rows: I32  # (n, 2) previous, current
    before: F32  # (n, 2, 3)
    endpoints: F32  # (k, 2, 3) current
    covariance: F32  # (k, 2, 3, 3)


class PlanePairs(NamedTuple):
    """n planes of the previous frame, and which of the current ones they are."""

    rows: I32  # (n, 2) previous, current
    before: F64  # (n, 4)
    before_covariance: F64  # (n, 3, 3) of (a, b, d)
    planes: F64  # (k, 4) current
    covariance: F64  # (k, 3, 3)


def pairs_of(tracks: Tracks, keypoints: Keypoints, segments: Segments, planes: Planes) -> tuple[PointPairs, LinePairs, PlanePairs]:
    """The tracks with the current features."""
    return (
        PointPairs(tracks.keypoints, tracks.points_m, tracks.sigma_m, keypoints.points_m, keypoints.sigma_px, keypoints.sigma_m),
        LinePairs(tracks.segments, tracks.endpoints_m, segments.endpoints_m, segments.covariance_m2),
        PlanePairs(tracks.planes, tracks.coefficients, tracks.plane_covariance, planes.coefficients, planes.covariance),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def point_pairs(pairs: PointPairs, rad_per_px: float, step: int, p: F64, q: F64, information: F64) -> int:
    """Write previous and current places (m, 3) and information (m, 3, 3), 1/m², of one in `step` of those of n pairs that both have depth; returns
    their number m."""
    rows, before, before_sigma, points, sigma_px, sigma_m = pairs
    m, seen = 0, 0
    for i in range(len(rows)):
        row = rows[i, 1]
        z = float(points[row, 2])
        if not (np.isfinite(before[i, 2]) and np.isfinite(z)):
            continue
        seen += 1
        if (seen - 1) % step:
            continue
        across = sigma_px[row] * rad_per_px * np.sqrt(float(before[i, 2]) ** 2 + z * z)
        along2 = float(before_sigma[i]) ** 2 + float(sigma_m[row]) ** 2
        for k in range(3):
            p[m, k], q[m, k] = before[i, k], points[row, k]
        x, y = q[m, 0] / z, q[m, 1] / z
        shrink = along2 / (across * across + along2 * (x * x + y * y + 1.0))  # Sherman–Morrison
        total = 0.0
        for a in range(3):
            for b in range(3):
                ray = (x if a == 0 else y if a == 1 else 1.0) * (x if b == 0 else y if b == 1 else 1.0)
                information[m, a, b] = ((1.0 if a == b else 0.0) - shrink * ray) / (across * across)
                total += information[m, a, b]
        m += np.isfinite(total)
    return m


@numba.njit(cache=True, nogil=True, error_model="numpy")
def line_pairs(pairs: LinePairs, rad_per_px: float, step: int, m: int, p: F64, q: F64, information: F64) -> int:
    """Write both ends of one in `step` of n previous lines, each against the start of the current line, whose noise serves for both: places and
    information from row m on, which is zero along the line. Returns the next row."""
    rows, before, endpoints, covariance = pairs
    seen, direction, B, S = 0, np.empty(3), np.empty((3, 2)), np.empty((2, 2))
    for i in range(len(rows)):
        row = rows[i, 1]
        length2, known = 0.0, 0.0
        for k in range(3):
            direction[k] = float(endpoints[row, 1, k]) - float(endpoints[row, 0, k])
            length2 += direction[k] * direction[k]
            known += before[i, 0, k] + before[i, 1, k]
        if not (length2 > SHORTEST_M * SHORTEST_M and np.isfinite(length2) and np.isfinite(known)):
            continue
        seen += 1
        if (seen - 1) % step:
            continue
        for k in range(3):
            direction[k] /= np.sqrt(length2)
        basis(direction, B)
        floor = max(rad_per_px * float(endpoints[row, 0, 2]), 1e-6) ** 2
        for a in range(2):
            for b in range(2):
                S[a, b] = floor if a == b else 0.0
                for j in range(3):
                    for k in range(3):
                        S[a, b] += B[j, a] * (float(covariance[row, 0, j, k]) + float(covariance[row, 1, j, k])) * B[k, b]
        det = S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0]
        if not (det > 0.0 and np.isfinite(det)):
            continue
        for end in range(2):
            for a in range(3):
                p[m + end, a], q[m + end, a] = before[i, end, a], endpoints[row, 0, a]
                for b in range(3):
                    first, second = S[1, 1] * B[b, 0] - S[0, 1] * B[b, 1], S[0, 0] * B[b, 1] - S[1, 0] * B[b, 0]
                    information[m + end, a, b] = 0.5 * (B[a, 0] * first + B[a, 1] * second) / det
        m += 2
    return m


@numba.njit(cache=True, nogil=True, error_model="numpy")
def plane_pairs(pairs: PlanePairs, floor: float) -> tuple[F64, F64, F64]:
    """Previous planes (m, 4), current ones, and the information (m, 4, 4) of their difference in (n, d), of those of n pairs that are known;
    `floor` (rad) is the least error of a normal."""
    rows, before, before_covariance, planes, covariance = pairs
    m, p, q, information = 0, np.empty((len(rows), 4)), np.empty((len(rows), 4)), np.zeros((len(rows), 4, 4))
    B, C = np.empty((3, 2)), np.empty((3, 3))
    for i in range(len(rows)):
        row, total = rows[i, 1], 0.0
        for a in range(3):
            for b in range(3):
                C[a, b] = before_covariance[i, a, b] + covariance[row, a, b]
                total += C[a, b]
            C[a, a] += floor * floor if a < 2 else 0.0
        for k in range(4):
            p[m, k], q[m, k] = before[i, k], planes[row, k]
            total += p[m, k] + q[m, k]
        if not np.isfinite(total):
            continue
        A = inverse_positive(C)
        if A[0, 0] == 0.0:
            continue
        basis(q[m, :3], B)
        for a in range(3):
            for b in range(3):
                information[m, a, b] = 0.0
                for u in range(2):
                    for v in range(2):
                        information[m, a, b] += B[a, u] * A[u, v] * B[b, v]
            information[m, a, 3] = B[a, 0] * A[0, 2] + B[a, 1] * A[1, 2]
            information[m, 3, a] = information[m, a, 3]
        information[m, 3, 3] = A[2, 2]
        m += 1
    return p[:m], q[:m], information[:m]
