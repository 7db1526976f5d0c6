"""Which landmarks a camera should see, and where."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from trihedron.pipeline.geometry import invert, transform
from trihedron.pipeline.types import F32, F64, I32, U8, Bool, Camera, Frame, Table
from trihedron.plugins.numerics.algebra.constant_arrays import constant

NEAR_M = 0.1
HIDDEN_M, HIDDEN_SIGMAS = 0.1, 5.0  # of depth, by which something is in front
MAX_SCALE_CHANGE = 2.0  # of the distance; beyond, a point does not look the same


@dataclass(frozen=True)
class VisiblePoints:
    """Landmark ids (n,) with pixel (n, 2), depth (n,) and predicted octave (n,)."""

    ids: I32
    pixels: F64
    depth_m: F64
    octaves: U8


def visible_points(points: Table, ids: I32, T_world_camera: F64, camera: Camera, view_deg: float, octave_scale: float) -> VisiblePoints:
    """Those of the points `ids` that lie in the image, are seen from within `view_deg` of the last direction and at a similar distance."""
    world, directions, distances, seen_at = points.gathered(ids, "position_m", "direction", "distance_m", "octave")
    intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy), camera.width, camera.height)
    cosine, log_scale = float(np.cos(np.radians(view_deg))), float(np.log(octave_scale))
    rows, pixels, depth, octaves = _seen(world, directions, distances, seen_at, constant(T_world_camera, np.float64), intrinsics, cosine, log_scale)
    return VisiblePoints(ids[rows], pixels, depth, octaves)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _seen(
    points: F64, directions: F32, distances: F32, octaves: U8, T_world_camera: F64, intrinsics: tuple[float, float, float, float, int, int],
    cosine: float, log_scale: float,
) -> tuple[I32, F64, F64, U8]:  # fmt: skip
    """Rows of the points that should be seen, their pixels (n, 2), depths and octaves (n,)."""
    fx, fy, cx, cy, width, height = intrinsics
    rows, n = np.empty(len(points), np.int32), 0
    pixels, depth, levels = np.empty((len(points), 2)), np.empty(len(points)), np.empty(len(points), np.uint8)
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


def visible_planes(planes: Table, ids: I32, T_world_camera: F64, frame: Frame) -> I32:
    """Those of the planes `ids` that the camera should see from the side they were seen from: half their samples, or more, lie in the image, and the
    frame's depth does not hide them."""
    coefficients, samples = planes.gathered(ids, "coefficients", "samples_m")
    local = transform(invert(T_world_camera), samples.astype(np.float64))
    pixels = frame.camera.project(local)
    inside = (local[..., 2] > NEAR_M) & in_image(pixels, frame.camera)
    x, y = np.rint(np.where(inside[..., None], pixels, 0.0)).astype(int).transpose(2, 0, 1)
    depth = frame.depth_m[y, x].astype(np.float64)
    open_to = inside & (depth > 0.0) & (local[..., 2] < depth + HIDDEN_M + HIDDEN_SIGMAS * frame.camera.depth_noise.sigma_m(depth))
    facing = coefficients[:, :3] @ T_world_camera[:3, 3] + coefficients[:, 3] > 0.0
    return np.asarray(ids[facing & (open_to.sum(axis=1) >= 0.5 * np.isfinite(samples[..., 0]).sum(axis=1))], np.int32)


def in_image(pixels: F64, camera: Camera) -> Bool:
    """(n,) whether pixels (n, 2) fall in the image; NaN does not."""
    with np.errstate(invalid="ignore"):
        x, y = pixels[..., 0], pixels[..., 1]
        inside: Bool = (x >= -0.5) & (x <= camera.width - 0.5) & (y >= -0.5) & (y <= camera.height - 0.5)
    return inside


def clip_segments(endpoints_m: F64, camera: Camera) -> tuple[F64, Bool]:
    """Project camera-frame segments (n, 2, 3), cut where they pass behind the camera or leave the image.

    Returns (n, 2, 2) pixels and (n,) whether anything (more than a pixel) is left (Liang–Barsky)."""
    a, b = endpoints_m[:, 0], endpoints_m[:, 1]
    step = np.where(np.abs(b[:, 2] - a[:, 2]) < 1e-9, 1e-9, b[:, 2] - a[:, 2])
    cut = ((NEAR_M - a[:, 2]) / step)[:, None]
    start = np.where((a[:, 2] < NEAR_M)[:, None], a + cut * (b - a), a)
    end = np.where((b[:, 2] < NEAR_M)[:, None], a + cut * (b - a), b)
    front = (a[:, 2] >= NEAR_M) | (b[:, 2] >= NEAR_M)
    p, q = camera.project(start), camera.project(end)
    low, high = np.zeros(len(p)), np.ones(len(p))
    for axis, size in ((0, camera.width), (1, camera.height)):
        delta = np.where(np.abs(q[:, axis] - p[:, axis]) < 1e-9, 1e-9, q[:, axis] - p[:, axis])
        first, last = (-0.5 - p[:, axis]) / delta, (size - 0.5 - p[:, axis]) / delta
        low, high = np.maximum(low, np.minimum(first, last)), np.minimum(high, np.maximum(first, last))
    pixels = np.stack([p + low[:, None] * (q - p), p + high[:, None] * (q - p)], axis=1)
    length = (high - low) * np.linalg.norm(q - p, axis=1)
    return pixels, front & (length > 1.0)
