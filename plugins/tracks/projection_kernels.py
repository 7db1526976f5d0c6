"""Kernels of `projection.py`: features of the previous frame predicted by a motion, and the pairs that agree with it."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32
from trihedron.plugins.shared.feature_matching_kernels import transform_plane_samples
from trihedron.plugins.tracks.feature_pairs_kernels import predict_pixel

Intrinsics = tuple[float, float, float, float]


class FeaturePositions(NamedTuple):
    """Points and lines of a frame, as kernels read them."""

    pixels: F32  # (n, 2)
    points_m: F32  # (n, 3)
    sigma_px: F32  # (n,)
    endpoints_px: F32  # (m, 2, 2)
    endpoints_m: F32  # (m, 2, 3)


@kernel
def predict_features(before: FeaturePositions, planes: F64, samples_m: F32, camera: Intrinsics, R: F64, t: F64) -> tuple[F32, F32, F64, F32]:
    """Predict pixels (n, 2) and ends of lines (m, 2, 2) of the previous frame, its planes (p, 4) and points on them (p, s, 3), by a motion."""
    pixels, ends = np.empty((len(before.pixels), 2), np.float32), np.empty((len(before.endpoints_px), 2, 2), np.float32)
    for i in range(len(pixels)):
        pixels[i, 0], pixels[i, 1] = _predict_point(before.pixels, before.points_m, i, camera, R, t)
    for i in range(len(ends)):
        for e in range(2):
            ends[i, e, 0], ends[i, e, 1] = _predict_end(before, i, e, camera, R, t)
    coefficients, samples = transform_plane_samples(planes, samples_m, R, t)
    return pixels, ends, coefficients, samples


@kernel
def _predict_point(pixels: F32, points_m: F32, i: int, camera: Intrinsics, R: F64, t: F64) -> tuple[float, float]:
    """Predict key point i."""
    return predict_pixel(pixels[i, 0], pixels[i, 1], points_m[i, 0], points_m[i, 1], points_m[i, 2], camera, R, t)


@kernel
def _predict_end(shown: FeaturePositions, i: int, end: int, camera: Intrinsics, R: F64, t: F64) -> tuple[float, float]:
    """Predict an end of line i."""
    px, m = shown.endpoints_px, shown.endpoints_m
    return predict_pixel(px[i, end, 0], px[i, end, 1], m[i, end, 0], m[i, end, 1], m[i, end, 2], camera, R, t)


@kernel
def consistent_pairs(
    points: I32, lines: I32, before: FeaturePositions, now: FeaturePositions, camera: Intrinsics, R: F64, t: F64, unsure_px: float, error_px: float
) -> tuple[I32, I32]:
    """Select the pairs (previous, current) of points and lines that agree with a motion whose translation has a σ of `unsure_px` at depth 1."""
    good_points, good_lines, n, m = np.empty((len(points), 2), np.int32), np.empty((len(lines), 2), np.int32), 0, 0
    R_back, t_back = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        t_back[a] = -(R[0, a] * t[0] + R[1, a] * t[1] + R[2, a] * t[2])
        for b in range(3):
            R_back[a, b] = R[b, a]
    for k in range(len(points)):
        i, j = points[k, 0], points[k, 1]
        then, since = float(before.points_m[i, 2]), float(now.points_m[j, 2])
        if np.isfinite(then):
            u, v = _predict_point(before.pixels, before.points_m, i, camera, R, t)
            x, y = u - now.pixels[j, 0], v - now.pixels[j, 1]
            depth = since if since < then else then
        elif np.isfinite(since):
            u, v = _predict_point(now.pixels, now.points_m, j, camera, R_back, t_back)
            x, y, depth = u - before.pixels[i, 0], v - before.pixels[i, 1], since
        else:
            continue
        if np.sqrt(x * x + y * y) <= error_px * (now.sigma_px[j] + (unsure_px / depth if depth > 0.0 else 0.0)):
            good_points[n, 0], good_points[n, 1] = i, j
            n += 1
    for k in range(len(lines)):
        i, j = lines[k, 0], lines[k, 1]
        x, y = float(now.endpoints_px[j, 0, 0]), float(now.endpoints_px[j, 0, 1])
        along_x, along_y = now.endpoints_px[j, 1, 0] - x, now.endpoints_px[j, 1, 1] - y
        length, off = max(np.sqrt(along_x * along_x + along_y * along_y), 1e-9), 0.0
        for e in range(2):
            u, v = _predict_end(before, i, e, camera, R, t)
            off += 0.5 * abs((v - y) * along_x - (u - x) * along_y) / length
        depth = min(float(before.endpoints_m[i, 0, 2]), float(before.endpoints_m[i, 1, 2]))
        if off <= error_px * (1.0 + unsure_px / (depth if depth > 0.0 else 1.0)):
            good_lines[m, 0], good_lines[m, 1] = i, j
            m += 1
    return good_points[:n], good_lines[:m]
