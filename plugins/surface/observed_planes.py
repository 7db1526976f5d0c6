"""The planar regions of views as observations of planes in the world, and their points on these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.geometry import transform_planes
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.keyframe_views import KeyframeView

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


def points_on_planes(views: Sequence[tuple[KeyframeView, F64]], found: ViewPlanes, axes: Sequence[F64], spacing_m: float, step: int) -> list[F64]:
    """For each plane the points (n, 2) seen of it, in its axes (3, 2): the mean of those in each square of `spacing_m`."""
    gathered: list[list[F64]] = [[] for _ in axes]
    for (view, T), rows in zip(views, found.regions):
        points, labels = labelled_points(view, T, step)
        for p in np.unique(rows[rows >= 0]):
            gathered[p].append(matmul(points[np.isin(labels, np.flatnonzero(rows == p))], axes[p]))
    return [_cell_means(np.concatenate([np.empty((0, 2)), *parts]), spacing_m) for parts in gathered]


def _cell_means(flat: F64, spacing_m: float) -> F64:
    """The mean (m, 2) of the points (n, 2) in each square."""
    cells = np.floor(flat / spacing_m).astype(np.int64)
    low = cells.min(axis=0) if len(cells) else np.zeros(2, np.int64)
    cells = cells - low
    _, which = np.unique(cells[:, 0] * (cells[:, 1].max() + 1 if len(cells) else 1) + cells[:, 1], return_inverse=True)
    count = np.maximum(np.bincount(which), 1)
    return np.stack([np.bincount(which, flat[:, k]) / count for k in (0, 1)], axis=1)
