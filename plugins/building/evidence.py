"""The evidence that every plan of a building is made of: planar points in the building's frame, their normals, areas and views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.shared.keyframe_views import KeyframeView

CORRELATED = 4.0  # neighbouring keyframes that err alike
SYSTEMATIC_M = 0.002  # what no averaging removes
SCALE = 0.0007  # standard deviation of the scale of the depth, and so of all lengths
LEVEL_DEG, UPRIGHT_DEG = 10.0, 10.0  # a region leaning by less is level, or upright


@dataclass(frozen=True)
class Evidence:
    """Planar points (n, 3) in the building's frame with the unit normals (n, 3) of their regions, information (n,) of their depth (1/m²) along the
    normal, area (n,) and the view (n,) that shows them; the views in the order of time with `T_building_camera` and the covariance (3, 3) of their
    positions, m²."""

    T_world_building: F64
    views: list[KeyframeView]
    poses: list[F64]
    drift_m2: F64
    points: F64
    normals: F64
    information: F64
    area_m2: F64
    rows: I32

    @cached_property
    def eyes(self) -> F64:
        """Return where the views were taken (v, 3)."""
        return np.array([T[:3, 3] for T in self.poses])

    @cached_property
    def upright(self) -> Bool:
        """Say of each point (n,) if its region is upright."""
        return np.asarray(np.abs(self.normals[:, 2]) < np.sin(np.radians(UPRIGHT_DEG)), np.bool_)

    def select(self, mask: Bool) -> Evidence:
        """Return the evidence of the points (n,) that the mask marks."""
        return replace(
            self, points=self.points[mask], normals=self.normals[mask], information=self.information[mask], area_m2=self.area_m2[mask],
            rows=self.rows[mask],
        )  # fmt: skip


def drift_variance(evidence: Evidence, direction: F64, information: F64, rows: I32) -> float:
    """Return the variance along a unit direction (3,) of the mean of readings by views `rows` (n,), m², that their poses in the world cause.

    The errors of poses are a random walk, in which the covariance of two is the variance of the earlier."""
    total = np.bincount(rows, information, len(evidence.poses))
    weight = total / total.sum()
    later = np.cumsum(weight[::-1])[::-1] - weight
    return float(matmul(weight * (weight + 2.0 * later), matmul(evidence.drift_m2, direction, direction)))


def mean_over_views(values: F64, information: F64, rows: I32) -> tuple[float, float]:
    """Return the mean of readings and its standard deviation: by the scatter of the views' own means, as readings of one view err together."""
    if len(values) == 0:
        return float("nan"), float("nan")
    count = int(rows.max()) + 1
    weight = np.bincount(rows, information, count)
    seen = weight > 0.0
    means = np.bincount(rows, information * values, count)[seen] / weight[seen]
    share = np.minimum(weight[seen], 4.0 * np.median(weight[seen]))
    share = share / share.sum()
    mean = float(matmul(share, means))
    for _ in range(3):
        away = np.abs(means - mean)
        robust = share * np.minimum(1.0, 0.01 / np.maximum(away, 1e-9))
        mean = float(matmul(robust, means) / robust.sum())
    scatter = float(matmul(share, (means - mean) ** 2))
    views = 1.0 / float(matmul(share, share))
    return mean, float(np.sqrt(scatter / max(views / CORRELATED, 1.0) + SYSTEMATIC_M**2))
