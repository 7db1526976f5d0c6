"""The planar regions of views as observations of planes in the world, and their points gathered on these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import transform_planes
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.keyframe_views import KeyframeView
from trihedron.plugins.shared.voxel_hash_kernels import empty_table
from trihedron.plugins.surface.common_superpixels_kernels import COLUMNS, assigned_kernel, fuse, surfels_kernel

SAMPLE_STEP = 4  # px between the points that a region is compared by
SMALLEST = 30  # samples of a region that may be a plane of its own


@dataclass(frozen=True)
class ViewPlanes:
    """Planes (p, 4) in the world, and for each view the plane (n,) that each of its regions shows, -1 for none."""

    planes: F64
    regions: list[I32]


def observed_planes(views: Sequence[tuple[KeyframeView, F64]], planes: F64, angle_deg: float, distance_m: float) -> ViewPlanes:
    """Each region belongs to the plane of the given (n, 4) within the angle from which its points are nearest on average (the paper: 10° and 5 cm);
    a region without one begins a new plane."""
    cosine = np.cos(np.radians(angle_deg))
    known, regions = planes.copy(), []
    for view, T in views:
        own = transform_planes(T, view.coefficients)
        rows = np.full(len(own), -1, np.int32)
        points, labels = labelled_points(view, T, SAMPLE_STEP)
        for i, plane in enumerate(own):
            mine = points[labels == i]
            if len(mine) == 0:
                continue
            off = np.abs(matmul(mine, known[:, :3].T) + known[:, 3]).mean(axis=0)
            off[matmul(known[:, :3], plane[:3]) < cosine] = np.inf
            if len(off) and off.min() < distance_m:
                rows[i] = int(np.argmin(off))
            elif len(mine) >= SMALLEST:
                rows[i] = len(known)
                known = np.concatenate([known, plane[None]])
        regions.append(rows)
    return ViewPlanes(known, regions)


def labelled_points(view: KeyframeView, T_world_camera: F64, step: int) -> tuple[F64, I32]:
    """Every `step`-th reading of the view's regions: points (n, 3) in the world and their region (n,)."""
    depth, labels = view.depth_m[::step, ::step].astype(np.float64), view.labels[::step, ::step]
    r, c = np.nonzero((labels > 0) & (depth > 0.0))
    points = view.camera.back_project(np.stack([c, r], axis=1) * step, depth[r, c])
    return matmul(points, T_world_camera[:3, :3].T) + T_world_camera[:3, 3], labels[r, c].astype(np.int32) - 1


def gathered_points(views: Sequence[tuple[KeyframeView, F64]], found: ViewPlanes, axes: Sequence[F64], spacing_m: float, step: int) -> list[F64]:
    """For each plane the points (n, 2) seen of it, in its axes (3, 2): the mean of those in each square of `spacing_m`."""
    gathered: list[list[F64]] = [[] for _ in axes]
    for (view, T), rows in zip(views, found.regions):
        points, labels = labelled_points(view, T, step)
        for p in np.unique(rows[rows >= 0]):
            gathered[p].append(matmul(points[np.isin(labels, np.flatnonzero(rows == p))], axes[p]))
    return [_meaned(np.concatenate([np.empty((0, 2)), *parts]), spacing_m) for parts in gathered]


def _meaned(flat: F64, spacing_m: float) -> F64:
    """The mean (m, 2) of the points (n, 2) in each square."""
    cells = np.floor(flat / spacing_m).astype(np.int64)
    low = cells.min(axis=0) if len(cells) else np.zeros(2, np.int64)
    cells = cells - low
    _, which = np.unique(cells[:, 0] * (cells[:, 1].max() + 1 if len(cells) else 1) + cells[:, 1], return_inverse=True)
    count = np.maximum(np.bincount(which), 1)
    return np.stack([np.bincount(which, flat[:, k]) / count for k in (0, 1)], axis=1)


UNEVEN, UNEVEN_M = 1.5, 0.005  # standard deviations, and more, of a superpixel's points from its plane: it lies across an edge


def superpixels(view: KeyframeView, side_px: int, coarse_px: int) -> F64:
    """(n, 13) surfels of one view, camera frame: position, unit normal, RGB, radius, weight (1/m²), region of the view (-1 = none) and the number of
    views, 1. The side of a superpixel is `coarse_px` in planar regions and `side_px` elsewhere."""
    gray = view.color.astype(np.float32).mean(axis=2)
    c = view.camera
    intrinsics = c.intrinsics
    found = []
    for planar, side in ((True, coarse_px), (False, side_px)):
        mask = (view.depth_m > 0.0) & ((view.labels > 0) == planar)
        assigned = assigned_kernel(view.depth_m, gray, view.labels, mask, side)
        found.append(surfels_kernel(view.depth_m, view.color, view.labels, assigned, intrinsics, side, int(assigned.max()) + 1))
    surfels = np.concatenate(found)
    sigma = c.depth_noise.sigma_m(surfels[:, 2])
    flat = surfels[:, 10] <= (UNEVEN * sigma + UNEVEN_M) ** 2
    surfels[:, 10], surfels[:, 12] = 1.0 / sigma**2, 1.0
    return np.asarray(surfels[flat])


def moved(surfels: F64, T_a_b: F64) -> F64:
    """Surfels (n, 13) of frame b in frame a."""
    out = surfels.copy()
    out[:, :3] = matmul(surfels[:, :3], T_a_b[:3, :3].T) + T_a_b[:3, 3]
    out[:, 3:6] = matmul(surfels[:, 3:6], T_a_b[:3, :3].T)
    return out


def fused(views: Sequence[F64], cosine: float) -> F64:
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
        count = fuse(surfels, out, keys, heads, after, count, cosine)
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
