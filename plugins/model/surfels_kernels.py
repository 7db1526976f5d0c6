"""Kernels of `surfels.py`: the index map, fusion of a frame, and splatting."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool
from trihedron.plugins.model.downsampled_frame import NEAREST_M, PosedCamera

SPLAT_PX = 4  # most pixels that a surfel reaches from its centre
TOGETHER = 0.03  # share of the depth within which discs are one surface
ROUND = 1.4  # radius over half a pixel's diagonal on the surface: neighbours overlap


class Images(NamedTuple):
    """A downsampled frame (h, w): depth, normals in the camera frame (NaN = none), colour, and the standard deviation of a depth by centimetres."""

    depth_m: F32
    normals: F32
    color: U8
    noise: F64


@kernel
def _in_camera(s: F32, camera: PosedCamera) -> tuple[float, float, float]:
    """Position of a surfel in the camera frame."""
    R, t = camera.R_camera_world, camera.position_m
    a, b, c = s[0] - t[0], s[1] - t[1], s[2] - t[2]
    return R[0, 0] * a + R[0, 1] * b + R[0, 2] * c, R[1, 0] * a + R[1, 1] * b + R[1, 2] * c, R[2, 0] * a + R[2, 1] * b + R[2, 2] * c


@kernel
def index_map(surfels: F32, camera: PosedCamera, shape: tuple[int, int]) -> I32:
    """Row (h, w) of the nearest surfel whose centre projects to a pixel, -1 = none; surfels seen from behind are skipped."""
    fx, fy, cx, cy = camera.intrinsics
    R = camera.R_camera_world
    out, depth = np.full(shape, -1, np.int32), np.full(shape, np.inf)
    for i in range(len(surfels)):
        s = surfels[i]
        if s[10] == 0.0:
            continue
        x, y, z = _in_camera(s, camera)
        if z < NEAREST_M:
            continue
        u, v = int(np.floor(fx * x / z + cx + 0.5)), int(np.floor(fy * y / z + cy + 0.5))
        if u < 0 or v < 0 or u >= shape[1] or v >= shape[0] or z >= depth[v, u]:
            continue
        facing = 0.0
        for k in range(3):
            facing += s[3 + k] * (R[0, k] * x + R[1, k] * y + R[2, k] * z)
        if facing < 0.0:
            depth[v, u], out[v, u] = z, i
    return out


@kernel
def fuse(
    surfels: F32, seen: I32, pixels: I32, images: Images, camera: PosedCamera, index: int, apart: float, cosine: float, most: float
) -> tuple[Bool, F32]:  # fmt: skip
    """Fuse the pixels in place; returns the mask (n,) of changed surfels, and the new ones (m, 11)."""
    h, w = images.depth_m.shape
    fx, fy, cx, cy = camera.intrinsics
    R, t = camera.R_camera_world, camera.position_m
    changed, fresh, count = np.zeros(len(surfels), np.bool_), np.empty((h * w, 11), np.float32), 0
    p, n, q = np.empty(3), np.empty(3), np.empty(3)
    for r in range(h):
        for c in range(w):
            z, m = images.depth_m[r, c], images.normals[r, c]
            if z <= 0.0 or not np.isfinite(m[0]):
                continue
            q[0], q[1], q[2] = (c - cx) / fx * z, (r - cy) / fy * z, z
            for k in range(3):
                p[k] = R[0, k] * q[0] + R[1, k] * q[1] + R[2, k] * q[2] + t[k]
                n[k] = R[0, k] * m[0] + R[1, k] * m[1] + R[2, k] * m[2]
            limit = apart * images.noise[min(int(100.0 * z), len(images.noise) - 1)] + 0.005
            best, row, hidden = np.inf, -1, False
            for i in range(max(r - 1, 0), min(r + 2, h)):
                for j in range(max(c - 1, 0), min(c + 2, w)):
                    k = pixels[i, j]
                    if k < 0:
                        continue
                    s = surfels[k]
                    _, _, d = _in_camera(s, camera)
                    aside = (s[0] - p[0]) ** 2 + (s[1] - p[1]) ** 2 + (s[2] - p[2]) ** 2 - (d - z) ** 2
                    if abs(d - z) < limit and s[3] * n[0] + s[4] * n[1] + s[5] * n[2] > cosine:
                        if changed[k]:
                            hidden = hidden or aside < s[9] * s[9]  # another pixel has just measured what covers this one
                        elif aside < best:
                            best, row = aside, k
            cosine_ray = max(-(m[0] * q[0] + m[1] * q[1] + m[2] * q[2]) / np.sqrt(q[0] ** 2 + q[1] ** 2 + z * z), 0.3)
            radius = ROUND * 0.7071 * z / fx / cosine_ray
            if row >= 0:
                s = surfels[row]
                share = 1.0 / (s[10] + 1.0)
                size = 0.0
                for k in range(3):
                    s[k] += share * (p[k] - s[k])
                    s[3 + k] += share * (n[k] - s[3 + k])
                    s[6 + k] += share * (images.color[r, c, k] - s[6 + k])
                    size += s[3 + k] ** 2
                for k in range(3):
                    s[3 + k] /= np.sqrt(size)
                s[9], s[10] = min(s[9], radius), min(s[10] + 1.0, most)
                seen[row], changed[row] = index, True
            elif not hidden:
                for k in range(3):
                    fresh[count, k], fresh[count, 3 + k], fresh[count, 6 + k] = p[k], n[k], images.color[r, c, k]
                fresh[count, 9], fresh[count, 10] = radius, 1.0
                count += 1
    return changed, fresh[:count].copy()


@kernel
def splat(surfels: F32, camera: PosedCamera, shape: tuple[int, int], stable: float) -> tuple[F32, F32, F32]:
    """Splat the surfels as discs: depth (h, w), normals (h, w, 3) in the camera frame and colour (h, w, 3) of the nearest surface; those with a
    confidence below `stable` only where there is no other."""
    fx, fy, cx, cy = camera.intrinsics
    R = camera.R_camera_world
    depth, rank, weight = np.zeros(shape, np.float32), np.zeros(shape, np.uint8), np.zeros(shape, np.float32)
    normals, color = np.full((*shape, 3), np.nan, np.float32), np.zeros((*shape, 3), np.float32)
    n = np.empty(3)
    for i in range(len(surfels)):
        s = surfels[i]
        if s[10] == 0.0:
            continue
        x, y, z = _in_camera(s, camera)
        if z < NEAREST_M:
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if u < -SPLAT_PX or v < -SPLAT_PX or u > shape[1] - 1 + SPLAT_PX or v > shape[0] - 1 + SPLAT_PX:
            continue
        for k in range(3):
            n[k] = R[k, 0] * s[3] + R[k, 1] * s[4] + R[k, 2] * s[5]
        off = n[0] * x + n[1] * y + n[2] * z
        if off > -0.1 * z:
            continue
        wide = min(int(fx * s[9] / z) + 1, SPLAT_PX)
        level = 2 if s[10] >= stable else 1
        for r in range(max(int(v) - wide, 0), min(int(v) + wide + 2, shape[0])):
            for c in range(max(int(u) - wide, 0), min(int(u) + wide + 2, shape[1])):
                a, b = (c - cx) / fx, (r - cy) / fy
                along = n[0] * a + n[1] * b + n[2]
                if along > -0.05:
                    continue
                d = off / along
                if (a * d - x) ** 2 + (b * d - y) ** 2 + (d - z) ** 2 > s[9] * s[9]:
                    continue
                together = level == rank[r, c] and abs(d - depth[r, c]) < TOGETHER * z
                if level > rank[r, c] or (level == rank[r, c] and not together and d < depth[r, c]):
                    rank[r, c], weight[r, c], together = level, 0.0, True
                    normals[r, c] = 0.0
                if together:  # one surface: average its discs, since the nearest has the largest error
                    weight[r, c] += s[10]
                    share = s[10] / weight[r, c]
                    depth[r, c] += share * (d - depth[r, c])
                    for k in range(3):
                        normals[r, c, k] += share * (n[k] - normals[r, c, k])
                        color[r, c, k] += share * (s[6 + k] - color[r, c, k])
    return depth, normals, color
