"""Kernels of dense images: halving, block means, gradients, edge-preserving smoothing and normals."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, U8

EDGE = 0.03  # a reading farther than the nearest of its block by more than this share is behind an edge


@kernel
def halve_images(gray: F32, depth: F32) -> tuple[F32, F32]:
    """Halve intensity and depth (h, w), the depth without readings behind an edge."""
    h, w = gray.shape[0] // 2, gray.shape[1] // 2
    out, small = np.empty((h, w), np.float32), np.zeros((h, w), np.float32)
    for r in range(h):
        for c in range(w):
            near, total, count, light, lit = np.inf, 0.0, 0, 0.0, 0
            for k in range(4):
                g = gray[2 * r + k // 2, 2 * c + k % 2]
                if not np.isnan(g):
                    light, lit = light + g, lit + 1
            out[r, c] = light / lit if lit else np.nan
            for k in range(4):
                d = depth[2 * r + k // 2, 2 * c + k % 2]
                if d > 0.0 and d < near:
                    near = d
            for k in range(4):
                d = depth[2 * r + k // 2, 2 * c + k % 2]
                if d > 0.0 and d < near * (1.0 + EDGE):
                    total, count = total + d, count + 1
            if count:
                small[r, c] = total / count
    return out, small


@kernel
def gradients(gray: F32) -> tuple[F32, F32]:
    """Central differences along x and y, (h, w) each, a pixel; 0 at the border and beside what is not known."""
    h, w = gray.shape
    x, y = np.zeros((h, w), np.float32), np.zeros((h, w), np.float32)
    for r in range(1, h - 1):
        for c in range(1, w - 1):
            across, down = 0.5 * (gray[r, c + 1] - gray[r, c - 1]), 0.5 * (gray[r + 1, c] - gray[r - 1, c])
            if not (np.isnan(across) or np.isnan(down)):
                x[r, c], y[r, c] = across, down
    return x, y


@kernel
def smooth_depth(depth: F32, radius: int) -> F32:
    """Smooth depth (h, w) by the mean of the readings within `radius` pixels that are not across an edge; 0 stays 0."""
    h, w = depth.shape
    out = np.zeros((h, w), np.float32)
    for r in range(h):
        for c in range(w):
            z = depth[r, c]
            if z <= 0.0:
                continue
            total, count = 0.0, 0
            for i in range(max(r - radius, 0), min(r + radius + 1, h)):
                for j in range(max(c - radius, 0), min(c + radius + 1, w)):
                    if abs(depth[i, j] - z) < EDGE * z:
                        total, count = total + depth[i, j], count + 1
            out[r, c] = total / count
    return out


@kernel
def depth_normals(depth: F32, intrinsics: F64, reach: int) -> F32:
    """Estimate unit normals (h, w, 3) towards the camera from the points `reach` pixels to the left, right, above and below; NaN where one of them is
    missing or lies behind an edge."""
    h, w = depth.shape
    out = np.full((h, w, 3), np.nan, np.float32)
    for r in range(reach, h - reach):
        for c in range(reach, w - reach):
            z = depth[r, c]
            left, right, up, down = depth[r, c - reach], depth[r, c + reach], depth[r - reach, c], depth[r + reach, c]
            limit = (1.0 + 0.5 * reach) * EDGE * z
            if not (z > 0.0 and left > 0.0 and right > 0.0 and up > 0.0 and down > 0.0):
                continue
            if abs(left - z) > limit or abs(right - z) > limit or abs(up - z) > limit or abs(down - z) > limit:
                continue
            ax = ((c + reach - intrinsics[2]) * right - (c - reach - intrinsics[2]) * left) / intrinsics[0]
            ay = (r - intrinsics[3]) * (right - left) / intrinsics[1]
            az = right - left
            bx = (c - intrinsics[2]) * (down - up) / intrinsics[0]
            by = ((r + reach - intrinsics[3]) * down - (r - reach - intrinsics[3]) * up) / intrinsics[1]
            bz = down - up
            nx, ny, nz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
            size = np.sqrt(nx * nx + ny * ny + nz * nz)
            if size > 0.0:
                out[r, c, 0], out[r, c, 1], out[r, c, 2] = nx / size, ny / size, nz / size
    return out


@kernel
def average_blocks(depth: F32, color: U8, step: int) -> tuple[F32, U8]:
    """Average depth (h, w) and colour over blocks of step × step pixels; of the depth only the readings that are not behind an edge."""
    h, w = depth.shape[0] // step, depth.shape[1] // step
    small, paint = np.zeros((h, w), np.float32), np.empty((h, w, 3), np.uint8)
    for r in range(h):
        for c in range(w):
            near = np.inf
            red, green, blue = 0, 0, 0
            for y in range(r * step, (r + 1) * step):
                for x in range(c * step, (c + 1) * step):
                    red, green, blue = red + color[y, x, 0], green + color[y, x, 1], blue + color[y, x, 2]
                    if depth[y, x] > 0.0 and depth[y, x] < near:
                        near = depth[y, x]
            n = step * step
            paint[r, c, 0], paint[r, c, 1], paint[r, c, 2] = (2 * red + n) // (2 * n), (2 * green + n) // (2 * n), (2 * blue + n) // (2 * n)
            total, count = 0.0, 0
            for y in range(r * step, (r + 1) * step):
                for x in range(c * step, (c + 1) * step):
                    if depth[y, x] > 0.0 and depth[y, x] < near * (1.0 + EDGE):
                        total, count = total + depth[y, x], count + 1
            if count:
                small[r, c] = total / count
    return small, paint
