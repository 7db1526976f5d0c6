"""Which landmarks a camera should see, and where."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool, Camera, Frame, Table
from trihedron.plugins.mapping.visibility_kernels import NEAR_M, clipped, seen
from trihedron.plugins.shared.linalg import constant

POINT_COLUMNS = "position_m", "direction", "distance_m", "octave"  # what says whether a point is to be seen
HIDDEN_M, HIDDEN_SIGMAS = 0.1, 5.0  # of depth, by which something is in front


class VisiblePoints(NamedTuple):
    """Rows (n,) of the points asked for with pixel (n, 2), depth (n,) and predicted octave (n,)."""

    rows: I32
    pixels: F32
    depth_m: F64
    octaves: U8


def visible_points(points: Sequence[NDArray[Any]], T_world_camera: F64, camera: Camera, view_deg: float, octave_scale: float) -> VisiblePoints:
    """Those of the points, given by their columns `POINT_COLUMNS`, that lie in the image, are seen from within `view_deg` of the last direction and
    at a similar distance."""
    cosine, log_scale = math.cos(math.radians(view_deg)), math.log(octave_scale)
    position, direction, distance, octave = points
    T = constant(T_world_camera, np.float64)
    return VisiblePoints(*seen(position, direction, distance, octave, T, _pinhole(camera), cosine, log_scale))


def _pinhole(camera: Camera) -> tuple[float, float, float, float, int, int]:
    """The camera as kernels take it."""
    return float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy), camera.width, camera.height


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


def clip_segments(endpoints_m: F64, T_camera_world: F64, camera: Camera) -> tuple[F64, Bool]:
    """Project segments (n, 2, 3) of the world, cut where they pass behind the camera or leave the image.

    Returns (n, 2, 2) pixels and (n,) whether anything (more than a pixel) is left (Liang–Barsky)."""
    pixels, left = clipped(constant(endpoints_m, np.float64), constant(T_camera_world, np.float64), _pinhole(camera))
    return pixels, left
