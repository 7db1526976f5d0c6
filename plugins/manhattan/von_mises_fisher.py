"""The Manhattan frame as the mode of a directional distribution."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.linalg import inv
from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, PositiveInt, Range, Share
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, ManhattanFrame, Normals, Segments
from trihedron.plugins.manhattan.axis_fit_kernels import NOTHING_KNOWN, orthonormal
from trihedron.plugins.manhattan.directions import HALF_SPHERE, Directions, gather_directions
from trihedron.plugins.manhattan.directions_kernels import NORMALS_PER_SAMPLE
from trihedron.plugins.manhattan.mean_shift_kernels import mode_statistics, search_axes, shift_axes
from trihedron.plugins.manhattan.mode_verification_kernels import ModeLimits
from trihedron.plugins.manhattan.modes import Modes, verify_modes
from trihedron.plugins.manhattan.von_mises_fisher_kernels import AxisMixture, expectation_maximisation
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent


@register("manhattan", "von_mises_fisher")
@dataclass(frozen=True)
class VonMisesFisher:
    """Expectation–maximisation of a von Mises–Fisher mixture over the six signed axes (Straub, Bhandari, Leonard and Fisher, "Real-time Manhattan
    World Rotation Estimation in 3D", IROS 2015; its vMF-based estimate in closed form, with soft instead of hard assignment).

    Normals and lines have concentrations of their own on every axis, which are estimated with the rotation over a uniform background: the spread is
    what the data say, not what a cone cuts out, and the covariance follows from it. Detected planes are not looked at."""

    samples: Annotated[int, Range(10)] = 1500  # most normals used
    alike: Annotated[float, Range(1)] = 6.0  # neighbouring normals share pixels and the sensor's errors: of those used so many err as one
    max_iterations: PositiveInt = 25
    tolerance_deg: PositiveFloat = 0.01  # of a step
    start_spread_deg: Annotated[float, Range(0.5, 20)] = 10.0  # standard deviation about the axes assumed at first: how far EM can see
    prior: PositiveFloat = 10.0  # directions that say beforehand that an axis
    prior_spread_deg: Annotated[float, Range(0.5, 20)] = 4.0  # has this standard deviation
    max_spread_deg: Annotated[float, Range(0.5, 20)] = 12.0  # a wider axis is none
    line_weight_per_px: NonNegativeFloat = 0.1  # a line weighs like this many normals per pixel of its length
    min_share: Share = 0.05  # of all normals that an axis must gather
    min_lines: PositiveInt = 4  # or this many lines,
    min_line_share: Share = 0.15  # with this share of the lines' length
    min_explained: Share = 0.3  # share of all directions on the axes
    max_skew_deg: PositiveFloat = 3.0  # means further from a right angle do not belong to one Manhattan frame
    peak_spread_deg: Annotated[float, Range(0.5, 10)] = 2.0  # kernel with which peaks are looked for
    max_shift_deg: PositiveFloat = 0.5  # from the mean of a wall's normals to their peak, beyond the uncertainty of the mean; two walls have more
    axis_floor_deg: PositiveFloat = 0.1  # error of an axis however many directions it has
    floor_deg: PositiveFloat = 0.05  # of the whole rotation
    search_samples: Annotated[int, Range(10)] = 800  # most normals a search looks at
    max_age: PositiveInt = 5  # frames; with an older result the search is from everywhere

    def __call__(self, normals: Normals, segments: Segments, previous: ManhattanFrame | None) -> ManhattanFrame:
        """One rotation with id 0; `inliers` counts the directions that belong to an axis, `spread` is √(2/κ). `supported` False, with a large
        covariance, where the scene shows no two axes at right angles."""
        directions = gather_directions(normals.normals, segments, self.samples, self.line_weight_per_px)
        R, mixture, modes = self._fit(directions, previous, normals.index)
        R, covariance = self._rotation(mixture, modes, R)
        weight = np.where(self._strength(mixture) > 0.0, mixture.weight, 0.0)
        spread = (weight * 2.0 / mixture.concentration).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-9)
        inliers = np.round(mixture.number.sum(axis=0)).astype(np.int32)
        return ManhattanFrame.single(normals, R, covariance, inliers, np.where(modes.seen, np.sqrt(spread), np.nan), modes.supported)

    def _fit(self, directions: Directions, previous: ManhattanFrame | None, index: int) -> tuple[F64, AxisMixture, Modes]:
        """Fit from the previous axes; from everywhere when there are none, they are old or nothing supports them. See `_fit_from`."""
        start, near = np.eye(3) if previous is None else previous.rotations[0], None
        if previous is not None:
            near = self._fit_from(directions, start)
            if previous.supported and near[2].supported and index - previous.index <= self.max_age:
                return near
        few = directions.subsample(self.search_samples)
        found = search_axes(few.vectors, few.weights, HALF_SPHERE, np.radians(12.0), np.radians(4.0), 6, 2)
        far = self._fit_from(directions, nearest_equivalent(found, start))
        return far if far[2].supported or near is None else near

    def _fit_from(self, directions: Directions, start: F64) -> tuple[F64, AxisMixture, Modes]:
        """Return the rotation that EM reaches from a start (3, 3), the mixture when its axes are then free, and its modes, verified: in a
        Manhattan world they stay at right angles, elsewhere each goes to a wall of its own."""
        mixture = self._maximise(broad_mixture(start, np.radians(self.start_spread_deg) ** -2), directions, False)
        free = self._maximise(mixture, directions, True)
        limits, (vectors, weights, first) = self._limits, directions
        normals = np.stack([free.number[0], free.weight[0], 2.0 / free.concentration[0], 1.0 / free.concentration[0]], axis=1)
        peaks = shift_axes(vectors, weights, free.R, limits.cone, np.radians(self.peak_spread_deg), 20, 1e-4)
        shift = np.linalg.norm(np.cross(peaks, free.R, axis=0), axis=0)
        sigma = np.sqrt(normals[:, 2] / np.maximum(2.0 * normals[:, 0] / NORMALS_PER_SAMPLE, 1.0))
        normals[shift > np.radians(self.max_shift_deg) + 2.0 * sigma] = 0.0  # two walls taken for one
        lines = mode_statistics(vectors[first:], weights[first:], free.R, limits.cone)
        modes = verify_modes(limits, Modes(free.R, normals, lines, np.zeros(3, np.bool_), False), directions, None)
        return mixture.R if modes.seen.any() else start, free, modes

    def _maximise(self, mixture: AxisMixture, directions: Directions, free: bool) -> AxisMixture:
        """Maximise the likelihood by expectation–maximisation, with axes at right angles or free."""
        prior = np.radians(self.prior_spread_deg) ** -2
        return expectation_maximisation(mixture, *directions, self.prior, prior, free, self.max_iterations, np.radians(self.tolerance_deg))

    def _strength(self, mixture: AxisMixture) -> F64:
        """(2, 3) concentrations; 0 of those that are too wide to be an axis."""
        return np.where(mixture.concentration >= np.radians(self.max_spread_deg) ** -2, mixture.concentration, 0.0)

    def _rotation(self, mixture: AxisMixture, modes: Modes, R: F64) -> tuple[F64, F64]:
        """The most probable rotation of the axes seen, R where these are no Manhattan frame, and the covariance of phi (3, 3)."""
        independent = self._strength(mixture) * mixture.number / np.array([[self.alike], [1.0]])
        sigma2 = 1.0 / np.maximum(independent.sum(axis=0), 1e-9) + np.radians(self.axis_floor_deg) ** 2
        H = np.zeros((3, 3))
        if modes.seen.any() and (modes.supported or modes.seen.sum() < 2):
            strength = np.where(modes.seen, 1.0 / sigma2, 0.0)
            R = orthonormal(np.where(modes.seen, modes.axes, R), (strength + 1e-6 * strength.max()) / strength.max())
            H = isotropic_information(R.T, np.sqrt(sigma2))[modes.seen].sum(axis=0)
        covariance = inv(H + np.eye(3) / NOTHING_KNOWN) + np.eye(3) * np.radians(self.floor_deg) ** 2
        return R, covariance

    @cached_property
    def _limits(self) -> ModeLimits:
        cone, skew = np.radians(self.max_spread_deg), np.radians(self.max_skew_deg)
        return ModeLimits(cone, self.min_share, self.min_lines, self.min_line_share, cone**2, self.min_explained, skew)


def broad_mixture(R: F64, concentration: float) -> AxisMixture:
    """Initial mixture: nothing belongs anywhere yet."""
    none = np.zeros((2, 3))
    return AxisMixture(np.array(R), np.full((2, 3), concentration), np.full((2, 4), 0.25), np.zeros((2, 3, 3)), none, none)


def isotropic_information(directions: F64, sigma: F64) -> F64:
    """Return the information (n, 3, 3) of directions (n, 3) with an isotropic `sigma` (n,) rad."""
    return (np.eye(3) - directions[:, :, None] * directions[:, None, :]) / (sigma * sigma)[:, None, None]
