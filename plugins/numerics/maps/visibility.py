"""Which landmarks a camera should see, and where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.geometry import invert, transform
from trihedron.pipeline.types import F64, I32, U8, Bool, Camera, Table

NEAR_M = 0.1
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
    world = points.rows("position_m", ids)
    local = transform(invert(T_world_camera), world)
    pixels = camera.project(local)
    inside = (local[:, 2] > NEAR_M) & in_image(pixels, camera)
    ids, world, local, pixels = ids[inside], world[inside], local[inside], pixels[inside]
    away = T_world_camera[:3, 3] - world
    distance = np.linalg.norm(away, axis=1)
    change = points.rows("distance_m", ids) / distance
    good = np.einsum("ij,ij->i", away, points.rows("direction", ids)) > np.cos(np.radians(view_deg)) * distance
    good &= (change < MAX_SCALE_CHANGE) & (change > 1.0 / MAX_SCALE_CHANGE)
    ids = ids[good]
    octave = points.rows("octave", ids) + np.log(change[good]) / np.log(octave_scale)
    return VisiblePoints(ids, pixels[good], local[good, 2], np.clip(np.round(octave), 0, 255).astype(np.uint8))


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
