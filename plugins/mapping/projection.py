"""Projection of landmarks into a camera: which are visible, and the terms by which the pose optimiser compares them with a frame's features."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool, Camera, Frame, Keypoints, Map, Planes, Segments, Table
from trihedron.plugins.mapping.landmark_kernels import (
    MIN_DEPTH_M,
    clip_segments_kernel,
    line_terms_kernel,
    plane_terms_kernel,
    point_terms_kernel,
    visible_points_kernel,
)
from trihedron.plugins.shared.residuals_kernels import LineTerms, PlaneTerms, PointTerms

POINT_COLUMNS = "position_m", "direction", "distance_m", "octave"  # of the map, that `visible_points` needs
HIDDEN_M, HIDDEN_SIGMAS = 0.1, 5.0  # of depth, by which an occluding surface is in front

# Visibility.


class VisiblePoints(NamedTuple):
    """Rows (n,) of the visible points, with pixel (n, 2), depth (n,) and predicted octave (n,)."""

    rows: I32
    pixels: F32
    depth_m: F64
    octaves: U8


def visible_points(points: Sequence[NDArray[Any]], T_world_camera: F64, camera: Camera, view_deg: float, octave_scale: float) -> VisiblePoints:
    """Select the points, given by their columns `POINT_COLUMNS`, that lie in the image and are seen from within `view_deg` of the last viewing
    direction and at a similar distance."""
    cosine, log_scale = math.cos(math.radians(view_deg)), math.log(octave_scale)
    position, direction, distance, octave = points
    T = constant(T_world_camera, np.float64)
    return VisiblePoints(*visible_points_kernel(position, direction, distance, octave, T, _pinhole(camera), cosine, log_scale))


def _pinhole(camera: Camera) -> tuple[float, float, float, float, int, int]:
    """Return intrinsics and image size as plain numbers, for kernels."""
    return float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy), camera.width, camera.height


def visible_planes(planes: Table, ids: I32, T_world_camera: F64, frame: Frame) -> I32:
    """Select the planes `ids` that face the camera and of which at least half the samples lie in the image, not occluded by the frame's depth."""
    coefficients, samples = planes.columns_at(ids, "coefficients", "samples_m")
    local = transform(invert(T_world_camera), samples.astype(np.float64))
    pixels = frame.camera.project(local)
    inside = (local[..., 2] > MIN_DEPTH_M) & in_image(pixels, frame.camera)
    x, y = np.rint(np.where(inside[..., None], pixels, 0.0)).astype(int).transpose(2, 0, 1)
    depth = frame.depth_m[y, x].astype(np.float64)
    unoccluded = inside & (depth > 0.0) & (local[..., 2] < depth + HIDDEN_M + HIDDEN_SIGMAS * frame.camera.depth_noise.sigma_m(depth))
    facing = matmul(coefficients[:, :3], T_world_camera[:3, 3]) + coefficients[:, 3] > 0.0
    return np.asarray(ids[facing & (unoccluded.sum(axis=1) >= 0.5 * np.isfinite(samples[..., 0]).sum(axis=1))], np.int32)


def in_image(pixels: F64, camera: Camera) -> Bool:
    """Return True (n,) for pixels (n, 2) inside the image; False for NaN."""
    with np.errstate(invalid="ignore"):
        x, y = pixels[..., 0], pixels[..., 1]
        inside: Bool = (x >= -0.5) & (x <= camera.width - 0.5) & (y >= -0.5) & (y <= camera.height - 0.5)
    return inside


def clip_segments(endpoints_m: F64, T_camera_world: F64, camera: Camera) -> tuple[F64, Bool]:
    """Project segments (n, 2, 3) of the world, clipped at the camera and the image border (Liang–Barsky).

    Returns (n, 2, 2) pixels and True (n,) where more than a pixel is left."""
    return clip_segments_kernel(constant(endpoints_m, np.float64), constant(T_camera_world, np.float64), _pinhole(camera))


# Terms of the pose optimiser.


def point_terms(map: Map, keypoints: Keypoints, pairs: I32) -> PointTerms:
    """Pair key points (rows `pairs[:, 0]`) with their landmarks (ids `pairs[:, 1]`)."""
    rows = pairs[:, 0].copy()
    positions_m, information = map.points.columns_at(pairs[:, 1], "position_m", "information")
    return point_terms_kernel(positions_m, information, rows, keypoints.pixels, keypoints.points_m, keypoints.sigma_px, keypoints.sigma_m)


def line_terms(map: Map, segments: Segments, pairs: I32, T_world_camera: F64, camera: Camera, sigma_px: float) -> LineTerms:
    """Pair segments with their map lines, each line given by its points opposite the segment's ends: its parts beyond them were not observed."""
    rows = pairs[:, 0].copy()
    ends_m, information = map.lines.columns_at(pairs[:, 1], "endpoints_m", "information")
    seen_px, seen_m, noise = segments.endpoints_px, segments.endpoints_m, segments.covariance_m2
    return line_terms_kernel(ends_m, information, rows, seen_px, seen_m, noise, T_world_camera.copy(), camera.intrinsics, sigma_px)


def parameters_on(lines: F64, points: F64) -> F64:
    """Return the parameters (n, k), 0 = start and 1 = end, of the feet of points (n, k, 3) on lines (n, 2, 3)."""
    direction = lines[:, 1] - lines[:, 0]
    return np.asarray(np.einsum("nkj,nj->nk", points - lines[:, :1], direction) / np.maximum((direction**2).sum(-1), 1e-12)[:, None])


def points_along(endpoints: F64, covariance: F64, share: F64) -> tuple[F64, F64]:
    """Interpolate points (n, 2, 3) at the shares (n, 2) of lines (n, 2, 3), and their covariances (n, 2, 3, 3)."""
    s = share[..., None]
    points = (1.0 - s) * endpoints[:, :1] + s * endpoints[:, 1:]
    s = s[..., None]
    return points, (1.0 - s) ** 2 * covariance[:, :1] + s * s * covariance[:, 1:]


def plane_terms(map: Map, planes: Planes, same: I32, parallel: I32, perpendicular: I32, relation_sigma_deg: float) -> PlaneTerms:
    """Pair observed planes with the same, parallel and perpendicular map planes; walls are parallel to within `relation_sigma_deg`.

    The covariance of an observed normal that takes part in k relations is multiplied by k in each: it was measured once."""
    pairs = np.concatenate([same, parallel, perpendicular])
    coefficients, covariance = map.planes.columns_at(pairs[:, 1], "coefficients", "covariance")
    extra = math.radians(relation_sigma_deg) ** 2
    rows = len(same), len(same) + len(parallel)
    kinds, observed, noise = plane_terms_kernel(covariance, pairs, *rows, planes.coefficients, planes.covariance, extra)
    return PlaneTerms(kinds, coefficients, covariance, observed, noise)
