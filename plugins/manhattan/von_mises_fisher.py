"""The Manhattan frame as the mode of a directional distribution."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trihedron.pipeline.registry import register
from trihedron.pipeline.types import F64, ManhattanFrame, Normals, Segments
from trihedron.plugins.numerics.axis_fit import HALF_SPHERE, NOTHING_KNOWN, gather_directions
from trihedron.plugins.numerics.cube_symmetry import nearest_equivalent
from trihedron.plugins.numerics.direction_information import isotropic_information
from trihedron.plugins.numerics.manhattan_modes import NORMALS_PER_SAMPLE, Directions, ModeFinder, Modes
from trihedron.plugins.numerics.sphere_modes import mode_statistics, orthonormal, search_axes
from trihedron.plugins.numerics.von_mises_fisher import AxisMixture, broad_mixture, improved


@register("manhattan", "von_mises_fisher")
@dataclass(frozen=True)
class VonMisesFisher:
    """Expectation–maximisation of a von Mises–Fisher mixture over the six signed axes (Straub, Bhandari, Leonard and Fisher, "Real-time Manhattan
    World Rotation Estimation in 3D", IROS 2015; its vMF-based estimate in closed form, with soft instead of hard assignment).

    Normals and lines have concentrations of their own on every axis, which are estimated with the rotation over a uniform background: the spread is
    what the data say, not what a cone cuts out, and the covariance follows from it. Detected planes are not looked at."""

    samples: int = 1500  # most normals used
    max_iterations: int = 25
    tolerance_deg: float = 0.01  # of a step
    start_spread_deg: float = 10.0  # standard deviation about the axes assumed at first: how far EM can see
    prior: float = 10.0  # directions that say beforehand that an axis
    prior_spread_deg: float = 4.0  # has this standard deviation
    max_spread_deg: float = 12.0  # a wider axis is none
    line_weight_per_px: float = 0.1  # a line weighs like this many normals per pixel of its length
    min_share: float = 0.05  # of all normals that an axis must gather
    min_lines: int = 4  # or this many lines,
    min_line_share: float = 0.15  # with this share of the lines' length
    min_explained: float = 0.3  # share of all directions on the axes
    max_skew_deg: float = 3.0  # means further from a right angle do not belong to one Manhattan frame
    axis_floor_deg: float = 0.2  # error of an axis however many directions it has
    floor_deg: float = 0.1  # of the whole rotation
    search_samples: int = 800  # most normals a search looks at
    max_age: int = 5  # frames; with an older result the search is from everywhere

    def __post_init__(self) -> None:
        if self.max_iterations < 1 or min(self.samples, self.search_samples) < 10 or self.min_lines < 1 or self.max_age < 1:
            raise ValueError("max_iterations, samples, search_samples, min_lines, max_age: at least 1, 10, 10, 1 and 1")
        if min(self.tolerance_deg, self.prior, self.max_skew_deg, self.axis_floor_deg, self.floor_deg) <= 0.0 or self.line_weight_per_px < 0.0:
            raise ValueError("tolerance_deg, prior, max_skew_deg, axis_floor_deg, floor_deg, line_weight_per_px: must be positive")
        if not all(0.5 <= spread <= 20.0 for spread in (self.start_spread_deg, self.prior_spread_deg, self.max_spread_deg)):
            raise ValueError("start_spread_deg, prior_spread_deg, max_spread_deg: must be 0.5 to 20")
        if not all(0.0 <= share <= 1.0 for share in (self.min_share, self.min_line_share, self.min_explained)):
            raise ValueError("min_share, min_line_share, min_explained: must be 0 to 1")

    def __call__(self, normals: Normals, segments: Segments, previous: ManhattanFrame | None) -> ManhattanFrame:
        """One rotation with id 0; `inliers` counts the directions that belong to an axis, `spread` is √(2/κ). `supported` False, with a large
        covariance, where the scene shows no two axes at right angles."""
        directions = gather_directions(normals.normals, segments, self.samples, self.line_weight_per_px)
        start = np.eye(3) if previous is None else previous.rotations[0]
        mixture, modes = self._settled(directions, start)
        if previous is None or not (previous.supported and modes.supported and normals.index - previous.index <= self.max_age):
            few = directions.thinned(self.search_samples)
            found = search_axes(few.vectors, few.weights, HALF_SPHERE, np.radians(12.0), np.radians(4.0), 6, 2)
            far = self._settled(directions, nearest_equivalent(found, start))
            mixture, modes = far if far[1].supported or previous is None else (mixture, modes)
        R, covariance = self._rotation(mixture, modes, start)
        weight = np.where(self._strength(mixture) > 0.0, mixture.weight, 0.0)
        spread = (weight * 2.0 / mixture.concentration).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-9)
        return ManhattanFrame(
            index=normals.index,
            stamp_ns=normals.stamp_ns,
            rotations=R[None],
            ids=np.zeros(1, np.int32),
            covariance=covariance[None],
            inliers=np.round(mixture.number.sum(axis=0)).astype(np.int32)[None],
            spread=np.where(modes.seen, np.sqrt(spread), np.nan)[None],
            supported=modes.supported,
        )

    def _settled(self, directions: Directions, start: F64) -> tuple[AxisMixture, Modes]:
        """The mixture EM reaches from three axes, and the judgement on it."""
        mixture = broad_mixture(start, np.radians(self.start_spread_deg) ** -2)
        prior = np.radians(self.prior_spread_deg) ** -2
        for _ in range(self.max_iterations):
            before = mixture
            mixture = improved(before, directions.vectors, directions.weights, directions.first_line, self.prior, prior)
            step = np.linalg.norm(mixture.R - before.R) / np.sqrt(2.0)
            if step < np.radians(self.tolerance_deg) and np.all(np.abs(mixture.concentration / before.concentration - 1.0) < 0.01):
                break
        resultant = (self._strength(mixture)[:, None, :] * mixture.resultant).sum(axis=0)
        length = np.linalg.norm(resultant, axis=0)
        axes = np.where(length > 1e-9, resultant / np.maximum(length, 1e-9), mixture.R)
        normals = np.stack([mixture.number[0], mixture.weight[0], 2.0 / mixture.concentration[0], 1.0 / mixture.concentration[0]], axis=1)
        first = directions.first_line
        lines = mode_statistics(directions.vectors[first:], directions.weights[first:], axes, self._rules.cone)
        return mixture, self._rules.judged(Modes(axes, normals, lines, np.zeros(3, np.bool_), False), directions, None)

    def _strength(self, mixture: AxisMixture) -> F64:
        """(2, 3) concentrations; 0 of those that are too wide to be an axis."""
        return np.where(mixture.concentration >= np.radians(self.max_spread_deg) ** -2, mixture.concentration, 0.0)

    def _rotation(self, mixture: AxisMixture, modes: Modes, start: F64) -> tuple[F64, F64]:
        """The most probable rotation of the axes seen, and the covariance of phi (3, 3)."""
        independent = self._strength(mixture) * mixture.number / np.array([[NORMALS_PER_SAMPLE], [1.0]])
        sigma2 = 1.0 / np.maximum(independent.sum(axis=0), 1e-9) + np.radians(self.axis_floor_deg) ** 2
        if modes.seen.any() and (modes.supported or modes.seen.sum() < 2):
            strength = np.where(modes.seen, 1.0 / sigma2, 0.0)
            R = orthonormal(np.where(modes.seen, modes.axes, start), (strength + 1e-6 * strength.max()) / strength.max())
            H = isotropic_information(R.T, np.sqrt(sigma2))[modes.seen].sum(axis=0)
        else:
            R, H = mixture.R if modes.seen.any() else start, np.zeros((3, 3))
        covariance = np.linalg.inv(H + np.eye(3) / NOTHING_KNOWN) + np.eye(3) * np.radians(self.floor_deg) ** 2
        return R, covariance

    @cached_property
    def _rules(self) -> ModeFinder:
        widest = np.radians(self.max_spread_deg)
        return ModeFinder(
            widest, widest, 1, 1.0, self.min_share, self.min_lines, self.min_line_share, 1.0, self.min_explained, np.radians(self.max_skew_deg), False
        )
