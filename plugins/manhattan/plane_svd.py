"""The Manhattan frame from planes that stand at right angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.registry import register
from trihedron.pipeline.types import F64, I32, ManhattanFrame, Planes
from trihedron.plugins.numerics.axes.axis_fit import NOTHING_KNOWN, variance_scale
from trihedron.plugins.numerics.axes.cube_symmetry import nearest_equivalent
from trihedron.plugins.numerics.axes.minimal_frames import frames_through, same_axes, score_frames
from trihedron.plugins.numerics.axes.sphere_modes import assign_axes
from trihedron.plugins.numerics.motion.procrustes import normal_covariance, procrustes, procrustes_covariance, square_angles

PRIOR = 1.0 / NOTHING_KNOWN  # 1/rad², weight of the previous rotation: holds the angles that no plane tells
LARGEST_COS = 0.2  # of planes taken as perpendicular, however uncertain they are


@register("manhattan", "plane_svd")
@dataclass(frozen=True)
class PlaneSvd:
    """The pair of planes at right angles that explains most of all planes, then the rotation nearest to every plane on its axes (Yunus et al.,
    ManhattanSLAM, ICRA 2021; Schönemann, Psychometrika 1966).

    `R = U diag(1, 1, det U Vᵀ) Vᵀ` of `U S Vᵀ = Σ w ±n eᵀ` minimises `Σ w |±n − R e|²` over planes with normal n on axis e, w the inverse variance of
    the normal; an axis without a plane becomes the cross product of the others. Neither the grid of normals nor lines are looked at."""

    max_cos: float = 0.05  # of two planes taken as perpendicular, 0.01–0.09 in publications; twice their uncertainty is added
    reach_deg: float = 5.0  # a plane this near to an axis belongs to it
    min_share: float = 0.05  # of the image that the planes of an axis must cover
    min_explained: float = 0.5  # share of the planes' area on the axes
    loyalty: float = 1.2  # a pair with other axes than the previous must explain so many times more
    gate: float = 3.0  # σ at which a plane counts half
    plane_floor_deg: float = 0.3  # a wall's deviation from the axis
    floor_deg: float = 0.05  # of the whole rotation

    def __post_init__(self) -> None:
        if not 0.0 <= self.max_cos <= LARGEST_COS or not 0.5 <= self.reach_deg <= 20.0:
            raise ValueError("max_cos, reach_deg: must be 0 to 0.2 and 0.5 to 20")
        if not 0.0 < self.min_share <= 1.0 or not 0.0 <= self.min_explained <= 1.0 or self.loyalty < 1.0:
            raise ValueError("min_share, min_explained, loyalty: must be above 0 to 1, 0 to 1, and at least 1")
        if min(self.gate, self.plane_floor_deg, self.floor_deg) <= 0.0:
            raise ValueError("gate, plane_floor_deg, floor_deg: must be positive")

    def __call__(self, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """One rotation with id 0; `inliers` counts planes, `spread` is their angle to the axis. `supported` is False where no two axes have planes: a
        single plane still tells two of the three angles."""
        start = np.eye(3) if previous is None else previous.rotations[0]
        normals, spatial, variance, area = self._usable(planes)
        enough = area >= self.min_share * planes.labels.size * planes.stride**2
        R, supported = self._perpendicular(normals, area, variance, planes, start, previous is not None and previous.supported)
        if supported:
            axes = self._axes(normals, R)
            weights = 1.0 / variance
            for _ in range(2):
                R = procrustes(normals, weights, axes, R, PRIOR)
                axes = self._axes(normals, R)
                weights = 1.0 / (variance + square_angles(normals, axes, R) / self.gate**2)
        else:
            alone = enough & (enough.sum() == 1)
            axes, weights = np.where(alone, assign_axes(normals, start, np.pi), -1).astype(np.int32), 1.0 / variance
            R = procrustes(normals, weights, axes, start, PRIOR)
        square = square_angles(normals, axes, R)
        scale = variance_scale(float((weights * square).sum()), 2.0 * np.count_nonzero(axes >= 0) - 3.0)
        covariance = procrustes_covariance(spatial, weights, axes, R, PRIOR, scale) + np.eye(3) * np.radians(self.floor_deg) ** 2
        on = axes >= 0
        with np.errstate(invalid="ignore"):
            spread = np.sqrt(np.bincount(axes[on], (area * square)[on], 3) / np.bincount(axes[on], area[on], 3))
        return ManhattanFrame(
            index=planes.index,
            stamp_ns=planes.stamp_ns,
            rotations=R[None],
            ids=np.zeros(1, np.int32),
            covariance=covariance[None],
            inliers=np.bincount(axes[on], minlength=3).astype(np.int32)[None],
            spread=spread[None],
            supported=supported,
        )

    def _axes(self, normals: F64, R: F64) -> I32:
        return assign_axes(normals, R, np.radians(self.reach_deg))

    def _usable(self, planes: Planes) -> tuple[F64, F64, F64, F64]:
        """Normals (n, 3), their covariances (n, 3, 3) and variances (n,), rad², and areas (n,), px, of the planes whose normals are known."""
        spatial = normal_covariance(planes.coefficients, planes.covariance, np.radians(self.plane_floor_deg))
        variance = 0.5 * (spatial[:, 0, 0] + spatial[:, 1, 1] + spatial[:, 2, 2])
        good = np.isfinite(variance) & (variance > 0.0) & (planes.pixels > 0)
        return planes.coefficients[good, :3], spatial[good], variance[good], planes.pixels[good].astype(np.float64)

    def _perpendicular(self, normals: F64, area: F64, variance: F64, planes: Planes, start: F64, loyal: bool) -> tuple[F64, bool]:
        """The rotation through the best pair of planes, named as is nearest to `start`, and whether enough of the scene stands on its axes."""
        cosine = np.abs(normals @ normals.T)
        limit = np.minimum(self.max_cos + 2.0 * np.sqrt(variance[:, None] + variance[None]), LARGEST_COS)
        first, second = np.nonzero(np.triu(cosine <= limit, 1))
        if len(first) == 0:
            return start, False
        swap = variance[second] < variance[first]  # the first axis is the better known
        frames = frames_through(normals[np.where(swap, second, first)], normals[np.where(swap, first, second)])
        score = score_frames(frames, normals, area, np.full(len(normals), np.radians(self.reach_deg)))
        if loyal:
            score *= np.where(same_axes(frames, start), self.loyalty, 1.0)
        R = nearest_equivalent(frames[int(np.argmax(score))], start)
        on_axis = np.bincount(self._axes(normals, R) + 1, area, 4)[1:]
        enough = self.min_share * planes.labels.size * planes.stride**2
        return R, bool((on_axis >= enough).sum() >= 2 and on_axis.sum() >= self.min_explained * area.sum())
