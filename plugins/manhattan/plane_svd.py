"""The Manhattan frame from planes that stand at right angles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import PositiveFloat, PositiveShare, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, ManhattanFrame, Planes
from trihedron.plugins.manhattan.axis_fit_kernels import NOTHING_KNOWN, variance_scale
from trihedron.plugins.shared.manhattan_frames_kernels import (
    Walls,
    area_on_axes,
    assign_axes,
    inliers_and_spread,
    known_walls,
    perpendicular_pair,
    procrustes,
    procrustes_covariance,
    refine_rotation,
    square_angles,
)

PRIOR = 1.0 / NOTHING_KNOWN  # 1/rad², weight of the previous rotation: holds the angles that no plane determines
LARGEST_COS = 0.2  # of planes taken as perpendicular, however uncertain they are


@register("manhattan", "plane_svd")
@dataclass(frozen=True)
class PlaneSvd:
    """The pair of planes at right angles that explains most of all planes, then the rotation nearest to every plane on its axes (Yunus et al.,
    ManhattanSLAM, ICRA 2021; Schönemann, Psychometrika 1966).

    `R = U diag(1, 1, det U Vᵀ) Vᵀ` of `U S Vᵀ = Σ w ±n eᵀ` minimises `Σ w |±n − R e|²` over planes with normal n on axis e, w the inverse variance of
    the normal; an axis without a plane becomes the cross product of the others. Neither the grid of normals nor lines are looked at."""

    max_cos: Annotated[float, Range(0, LARGEST_COS)] = 0.05  # of perpendicular planes, 0.01–0.09 in publications; twice their uncertainty is added
    reach_deg: Annotated[float, Range(0.5, 20)] = 5.0  # a plane this near to an axis belongs to it
    min_share: PositiveShare = 0.05  # of the image that the planes of an axis must cover
    min_explained: Share = 0.5  # share of the planes' area on the axes
    loyalty: Annotated[float, Range(1)] = 1.2  # a pair with other axes than the previous must explain so many times more
    gate: PositiveFloat = 3.0  # σ at which a plane counts half
    plane_floor_deg: PositiveFloat = 0.3  # a wall's deviation from the axis
    floor_deg: PositiveFloat = 0.05  # of the whole rotation

    def __call__(self, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """One rotation with id 0; `inliers` counts planes, `spread` is their angle to the axis. `supported` is False where no two axes have planes: a
        single plane still determines two of the three angles."""
        start = np.eye(3) if previous is None else previous.rotations[0]
        walls = known_walls(planes.coefficients, planes.covariance, planes.pixels, np.radians(self.plane_floor_deg))
        enough = self.min_share * planes.labels.size * planes.stride**2
        R, supported = self._perpendicular(walls, enough, start, previous is not None and previous.supported)
        if supported:
            R, axes, weights = refine_rotation(walls, R, np.radians(self.reach_deg), self.gate, PRIOR, 2)
        else:
            R, axes, weights = _alone(walls, enough, start)
        square = square_angles(walls.normals, axes, R)
        scale = variance_scale(float(matmul(weights, square)), 2.0 * np.count_nonzero(axes >= 0) - 3.0)
        covariance = procrustes_covariance(walls.spatial, weights, axes, R, PRIOR, scale) + np.eye(3) * np.radians(self.floor_deg) ** 2
        inliers, spread = inliers_and_spread(square, axes, walls.area)
        return ManhattanFrame.single(planes, R, covariance, inliers, spread, supported)

    def _perpendicular(self, walls: Walls, enough: float, start: F64, loyal: bool) -> tuple[F64, bool]:
        """The rotation through the best pair of walls, named as is nearest to `start`, and whether enough of the scene stands on its axes."""
        reach = np.radians(self.reach_deg)
        found, R = perpendicular_pair(walls, self.max_cos, LARGEST_COS, reach, start, self.loyalty if loyal else 1.0)
        area = area_on_axes(walls, R, reach) if found else np.zeros(3)
        return R, bool((area >= enough).sum() >= 2 and area.sum() >= self.min_explained * walls.area.sum())


def _alone(walls: Walls, enough: float, start: F64) -> tuple[F64, I32, F64]:
    """The rotation from `start` to a single large wall, and the axes and weights of all walls; nothing else than that one counts."""
    large = walls.area >= enough
    axes = np.where(large & (large.sum() == 1), assign_axes(walls.normals, start, np.pi), -1).astype(np.int32)
    weights = 1.0 / walls.variance
    return procrustes(walls.normals, weights, axes, start, PRIOR), axes, weights
