"""What estimators have in common that end with the modes of the sphere: their options, and the way from modes to a Manhattan frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trihedron.pipeline.core.types import F64, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.numerics.axes.axis_fit import NOTHING_KNOWN, AxisFit, gather_directions
from trihedron.plugins.numerics.axes.manhattan_modes import Directions, ModeFinder, Modes
from trihedron.plugins.numerics.axes.sphere_modes import orthonormal


@dataclass(frozen=True)
class ModeOptions:
    """Base of the plugins that gather directions, find their modes and fit a rotation to what stands on these."""

    cone_deg: float = 12.0  # half-angle of the cone gathered around each axis, 10–15 in MVO, OPVO and LPVO
    bandwidth_deg: float = 4.0  # of the Gaussian kernel
    max_iterations: int = 20
    tolerance_deg: float = 1e-3
    samples: int = 3000  # most normals used
    use_normals: bool = True
    use_lines: bool = True
    use_planes: bool = True
    line_weight_per_px: float = 0.1  # a line weighs like this many normals per pixel of its length
    min_share: float = 0.05  # of all normals that an axis must gather, MVO: 1/20
    min_lines: int = 4  # or this many lines,
    min_line_share: float = 0.15  # with this share of the lines' length
    max_width: float = 0.44  # cones, standard deviation of a mode; 0.5 and 0.58 are the directions' without order, in space and in a plane
    min_explained: float = 0.3  # share of all directions on the axes; directions without order have 0.07
    max_skew_deg: float = 3.0  # two modes further from a right angle do not belong to one Manhattan frame
    normals_floor_deg: float = 0.5  # error of an axis however many normals it has
    plane_floor_deg: float = 0.3  # a wall's deviation from the axis
    line_floor_deg: float = 0.5  # an edge's
    floor_deg: float = 0.05  # of the whole rotation
    gate: float = 2.0  # σ at which a plane or line counts half

    def __post_init__(self) -> None:
        if not 1.0 <= self.cone_deg <= 30.0 or not 0.1 <= self.bandwidth_deg <= self.cone_deg:
            raise ValueError("cone_deg, bandwidth_deg: cone_deg must be 1 to 30 and bandwidth_deg 0.1 to cone_deg")
        if self.max_iterations < 1 or self.tolerance_deg <= 0.0 or self.samples < 10:
            raise ValueError("max_iterations, tolerance_deg, samples: at least 1, above 0, at least 10")
        if not (self.use_normals or self.use_lines):
            raise ValueError("use_normals, use_lines: at least one must be true")
        if self.line_weight_per_px < 0.0 or self.min_lines < 1 or self.max_skew_deg <= 0.0 or self.gate <= 0.0:
            raise ValueError("line_weight_per_px, min_lines, max_skew_deg, gate: at least 0, at least 1, above 0, above 0")
        if not all(0.0 <= share <= 1.0 for share in (self.min_share, self.min_line_share, self.max_width, self.min_explained)):
            raise ValueError("min_share, min_line_share, max_width, min_explained: must be 0 to 1")
        if min(self.normals_floor_deg, self.plane_floor_deg, self.line_floor_deg, self.floor_deg) <= 0.0:
            raise ValueError("normals_floor_deg, plane_floor_deg, line_floor_deg, floor_deg: must be positive")

    def directions(self, normals: Normals, segments: Segments) -> Directions:
        """Of the normals and lines that the options let take part."""
        surface, lines = normals.normals if self.use_normals else None, segments if self.use_lines else None
        return gather_directions(surface, lines, self.samples, self.line_weight_per_px)

    @cached_property
    def finder(self) -> ModeFinder:
        """Mean shift with these options."""
        return ModeFinder(
            np.radians(self.cone_deg),
            np.radians(self.bandwidth_deg),
            self.max_iterations,
            np.radians(self.tolerance_deg),
            self.min_share,
            self.min_lines,
            self.min_line_share,
            self.max_width,
            self.min_explained,
            np.radians(self.max_skew_deg),
            self.use_planes,
        )

    def fitted(self, modes: Modes, segments: Segments, planes: Planes) -> tuple[F64, F64]:
        """The rotation fitted to planes, lines and the modes of the normals near its axes, and the covariance of phi (3, 3)."""
        weights = np.where(modes.seen, modes.weights, 1e-6)
        R = orthonormal(modes.axes, weights / weights.max())
        taking_part = modes.seen | modes.supported
        R, covariance = self._fit(R, modes.axes, modes.normals, taking_part, segments, planes)
        known = modes.supported or modes.seen.sum() < 2
        return R, covariance if known else np.eye(3) * NOTHING_KNOWN

    def frame(self, modes: Modes, R: F64, covariance: F64, normals: Normals, gap: float = float("nan")) -> ManhattanFrame:
        """The one rotation R (3, 3) with id 0, and what its modes say of it."""
        counts = (modes.normals[:, 0] + modes.lines[:, 0]).astype(np.int32)
        return ManhattanFrame(
            index=normals.index,
            stamp_ns=normals.stamp_ns,
            rotations=R[None],
            ids=np.zeros(1, np.int32),
            covariance=covariance[None],
            inliers=counts[None],
            spread=np.where(modes.seen, np.sqrt(modes.mean_squares), np.nan)[None],
            supported=modes.supported,
            gap=gap,
        )

    @cached_property
    def _fit(self) -> AxisFit:
        return AxisFit(
            self.cone_deg,
            self.normals_floor_deg,
            self.plane_floor_deg,
            self.line_floor_deg,
            self.floor_deg,
            self.gate,
            self.use_planes,
            self.use_lines,
        )
