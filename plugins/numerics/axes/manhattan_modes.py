"""When three modes of the sphere are a Manhattan frame, and when they are not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, Bool, Planes
from trihedron.plugins.numerics.axes.mode_tests import largest_fitting, line_peaks, perpendicular, surface_peaks
from trihedron.plugins.numerics.axes.sphere_modes import mode_statistics, shift_axes

NO_PLANES = np.zeros((0, 5))
SIGMAS = 2.0  # that a plane may be off


class Directions(NamedTuple):
    """Unit directions (n, 3) with weights (n,): normals first, lines from row `first_line`."""

    vectors: F64
    weights: F64
    first_line: int

    def thinned(self, most: int) -> Directions:
        """With at most about `most` of the normals, which weigh the more, and all lines."""
        step = max(-(-self.first_line // most), 1)
        normals, lines = self.vectors[: self.first_line : step], self.vectors[self.first_line :]
        weights = np.concatenate([step * self.weights[: self.first_line : step], self.weights[self.first_line :]])
        return Directions(np.concatenate([normals, lines]), weights, len(normals))


class Modes(NamedTuple):
    """Three modes of the sphere and what stands behind them."""

    axes: F64  # (3, 3) columns, unit, at right angles only as far as the scene is
    normals: F64  # (3, 4) statistics of the normals about them, see `mode_statistics`
    lines: F64  # (3, 4) of the line directions
    seen: Bool  # (3,) modes that are peaks, at right angles to each other
    supported: bool

    @property
    def weights(self) -> F64:
        """(3,) of the directions on each axis."""
        return self.normals[:, 1] + self.lines[:, 1]

    @property
    def mean_squares(self) -> F64:
        """(3,) squared angle (rad²) of the directions on each axis."""
        return np.asarray((self.normals[:, 1] * self.normals[:, 2] + self.lines[:, 1] * self.lines[:, 2]) / np.maximum(self.weights, 1e-9))


@dataclass(frozen=True)
class ModeFinder:
    """Mean shift and the rules of `mode_options.ModeOptions`, whose fields these are; angles in rad."""

    cone: float
    bandwidth: float
    max_iterations: int
    tolerance: float
    min_share: float
    min_lines: int
    min_line_share: float
    max_width: float
    min_explained: float
    max_skew: float
    use_planes: bool

    def follow(self, directions: Directions, planes: Planes, start: F64) -> Modes:
        """Mean shift from three starting axes (3, 3), and what it found; axes that are no modes stay where they started."""
        shift = (self.cone, self.bandwidth, self.max_iterations, self.tolerance)
        return Modes(*_followed(*directions, np.array(start), shift, self._surfaces(planes), self._rules))

    def judged(self, modes: Modes, directions: Directions, planes: Planes | None) -> Modes:
        """The modes with those `seen` that are peaks at right angles, and whether these make a Manhattan frame; `planes` where they may take part."""
        seen, supported = _judged(*directions, modes.axes, modes.normals, modes.lines, self._surfaces(planes), self._rules)
        return modes._replace(seen=seen, supported=supported)

    def peaks(self, modes: Modes, directions: Directions, planes: Planes | None) -> Bool:
        """(m,) whether a plane, enough normals or enough lines stand on each axis, the latter two denser than directions without order would."""
        return np.asarray(_peaks(*directions, modes.axes, modes.normals, modes.lines, self._surfaces(planes), self._rules))

    def perpendicular(self, modes: Modes) -> Bool:
        """(m, m) whether two modes are at right angles, as far as their own uncertainty can tell."""
        return np.asarray(perpendicular(modes.axes, modes.normals, modes.lines, self.max_skew))

    def _surfaces(self, planes: Planes | None) -> F64:
        """(p, 5) of the planes that may take part, for `surface_peaks`: normal, cosine of the reach, share of the image. They reach half a cone, and
        as much further as they are uncertain, but no further than it."""
        if planes is None or not self.use_planes or len(planes.pixels) == 0:
            return NO_PLANES
        image = float(planes.labels.size * planes.stride**2)
        return np.asarray(_surfaces(planes.coefficients, planes.covariance, planes.pixels, image, self.cone))

    @cached_property
    def _rules(self) -> Rules:
        widest = (self.max_width * self.cone) ** 2
        return Rules(self.cone, self.min_share, self.min_lines, self.min_line_share, widest, self.min_explained, self.max_skew)


class Rules(NamedTuple):
    """Of `ModeFinder`, for the kernels; `widest` is the largest mean square of a mode."""

    cone: float
    min_share: float
    min_lines: int
    min_line_share: float
    widest: float
    min_explained: float
    max_skew: float


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _surfaces(planes: F64, covariance: F64, pixels: I32, image: float, cone: float) -> F64:
    """`ModeFinder._surfaces` of those planes (p, 4) that are known; `image` has so many pixels."""
    out, n = np.empty((len(planes), 5)), 0
    for i in range(len(planes)):
        variance = covariance[i, 0, 0] + covariance[i, 1, 1]
        if np.isfinite(variance + planes[i, 0] + planes[i, 1] + planes[i, 2]):
            for k in range(3):
                out[n, k] = planes[i, k]
            out[n, 3] = np.cos(min(0.5 * cone + SIGMAS * np.sqrt(max(variance, 0.0)), cone))
            out[n, 4] = pixels[i] / image
            n += 1
    return out[:n]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _followed(
    vectors: F64, weights: F64, first: int, start: F64, shift: tuple[float, float, int, float], planes: F64, rules: Rules
) -> tuple[F64, F64, F64, Bool, bool]:
    """The fields of `Modes`."""
    cone, bandwidth, iterations, tolerance = shift
    axes = shift_axes(vectors, weights, start, cone, bandwidth, iterations, tolerance)
    normals = mode_statistics(vectors[:first], weights[:first], axes, cone)
    lines = mode_statistics(vectors[first:], weights[first:], axes, cone)
    seen, supported = _judged(vectors, weights, first, axes, normals, lines, planes, rules)
    for k in range(3):
        if not seen[k]:
            for j in range(3):
                axes[j, k] = start[j, k]
    return axes, normals, lines, seen, supported


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _judged(vectors: F64, weights: F64, first: int, axes: F64, normals: F64, lines: F64, planes: F64, rules: Rules) -> tuple[Bool, bool]:
    """(3,) which modes are seen, and whether they make a Manhattan frame."""
    peaks = _peaks(vectors, weights, first, axes, normals, lines, planes, rules)
    on_axis = normals[:, 1] + lines[:, 1]
    seen = largest_fitting(peaks, perpendicular(axes, normals, lines, rules.max_skew), on_axis)
    explained = (on_axis * seen).sum() / max(weights.sum(), 1e-9)
    return seen, seen.sum() >= 2 and explained >= rules.min_explained


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _peaks(vectors: F64, weights: F64, first: int, axes: F64, normals: F64, lines: F64, planes: F64, rules: Rules) -> Bool:
    """(m,) which of the axes (3, m) are peaks."""
    cone, least, number, share, widest, _, _ = rules
    surfaces = surface_peaks(axes, normals, first, least, widest, planes)
    return surfaces | line_peaks(vectors[first:], weights[first:], axes, lines, number, share, widest, cone)
