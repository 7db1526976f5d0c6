"""Numba kernels of `visibility.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool

NEAR_M = 0.1
MAX_SCALE_CHANGE = 2.0  # of the distance; beyond, a point does not look the same


@kernel
def seen(
    points: F64, directions: F32, distances: F32, octaves: U8, T_world_camera: F64, intrinsics: tuple[float, float, float, float, int, int],
    cosine: float, log_scale: float,
) -> tuple[I32, F32, F64, U8]:  # fmt: skip
    """The fields of `VisiblePoints`."""
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
def clipped(world: F64, T: F64, intrinsics: tuple[float, float, float, float, int, int]) -> tuple[F64, Bool]:
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
