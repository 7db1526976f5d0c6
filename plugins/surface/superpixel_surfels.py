"""Surfels from the superpixels of views, fused, and drawn as discs (after Wang, Gao, Shen, ICRA 2019)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.shared.voxel_hash_kernels import empty_table
from trihedron.plugins.surface.superpixels_kernels import COLUMNS, assign_kernel, surfels_kernel
from trihedron.plugins.surface.surfels_kernels import fuse_kernel

UNEVEN, UNEVEN_M = 1.5, 0.005  # standard deviations, and more, of a superpixel's points from its plane: it lies across an edge


def cut_superpixels(view: KeyframeView, side_px: int, coarse_px: int) -> F64:
    """(n, 13) surfels of one view, camera frame: position, unit normal, RGB, radius, weight (1/m²), region of the view (-1 = none) and the number of
    views, 1. The side of a superpixel is `coarse_px` in planar regions and `side_px` elsewhere."""
    gray = view.color.astype(np.float32).mean(axis=2)
    c = view.camera
    intrinsics = c.intrinsics
    found = []
    for planar, side in ((True, coarse_px), (False, side_px)):
        mask = (view.depth_m > 0.0) & ((view.labels > 0) == planar)
        assigned = assign_kernel(view.depth_m, gray, view.labels, mask, side)
        found.append(surfels_kernel(view.depth_m, view.color, view.labels, assigned, intrinsics, side, int(assigned.max()) + 1))
    surfels = np.concatenate(found)
    sigma = c.depth_noise.sigma_m(surfels[:, 2])
    flat = surfels[:, 10] <= (UNEVEN * sigma + UNEVEN_M) ** 2
    surfels[:, 10], surfels[:, 12] = 1.0 / sigma**2, 1.0
    return np.asarray(surfels[flat])


def transform_surfels(surfels: F64, T_a_b: F64) -> F64:
    """Surfels (n, 13) of frame b in frame a."""
    out = surfels.copy()
    out[:, :3] = matmul(surfels[:, :3], T_a_b[:3, :3].T) + T_a_b[:3, 3]
    out[:, 3:6] = matmul(surfels[:, 3:6], T_a_b[:3, :3].T)
    return out


def fuse_surfels(views: Sequence[F64], cosine: float) -> F64:
    """(m, 13) the surfels (n, 13) of all views, those of the same place and direction as one: nearer than half a radius along and across their
    normals. Of the fused ones the radius is the smallest seen, the plane that of the first."""
    cells = max((len(s) for s in views), default=0)
    out = np.zeros((max(sum(map(len, views)), 1), COLUMNS))
    slots = 1 << 12
    while slots < 4 * max(sum(map(len, views)), cells):
        slots *= 2
    keys, heads = empty_table(slots)
    after = np.full(len(out), -1, np.int32)
    count = 0
    for surfels in views:
        count = fuse_kernel(surfels, out, keys, heads, after, count, cosine)
    return out[:count]


def discs(surfels: F64, corners: int = 6) -> tuple[F64, I32]:
    """Each surfel as a fan of triangles: vertices (m · corners, 3) and triangles (m · (corners - 2), 3), anticlockwise about its normal."""
    n = surfels[:, 3:6]
    side = np.cross(n, np.where(np.abs(n[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    side /= np.maximum(np.linalg.norm(side, axis=1), 1e-12)[:, None]
    up = np.cross(n, side)
    turn = np.arange(corners) * 2.0 * np.pi / corners
    ring = np.cos(turn)[None, :, None] * side[:, None] + np.sin(turn)[None, :, None] * up[:, None]
    vertices = surfels[:, None, :3] + surfels[:, 9, None, None] * ring
    k = np.arange(1, corners - 1)
    fan = np.stack([0 * k, k, k + 1], axis=1)
    triangles = (np.arange(len(surfels)) * corners)[:, None, None] + fan
    return vertices.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.int32)
