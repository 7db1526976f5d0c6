"""When three modes of the sphere are a Manhattan frame, and when they are not."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.types import F64, Bool, Planes
from trihedron.plugins.numerics.axes.sphere_modes import mode_statistics, shift_axes

NORMALS_PER_SAMPLE = 20.0  # neighbouring normals share pixels and the sensor's errors: so many count as one


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

    @property
    def independent(self) -> F64:
        """(3,) directions on each axis that err independently, at least one."""
        return np.maximum(self.normals[:, 0] / NORMALS_PER_SAMPLE + self.lines[:, 0], 1.0)


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
        vectors, weights, first = directions
        axes = shift_axes(vectors, weights, start, self.cone, self.bandwidth, self.max_iterations, self.tolerance)
        normals = mode_statistics(vectors[:first], weights[:first], axes, self.cone)
        lines = mode_statistics(vectors[first:], weights[first:], axes, self.cone)
        found = self.judged(Modes(axes, normals, lines, np.zeros(3, np.bool_), False), directions, planes)
        return found._replace(axes=np.where(found.seen, axes, start))

    def judged(self, modes: Modes, directions: Directions, planes: Planes | None) -> Modes:
        """The modes with those `seen` that are peaks at right angles, and whether these make a Manhattan frame; `planes` where they may take part."""
        seen = self._at_right_angles(modes, self.peaks(modes, directions, planes))
        explained = modes.weights[seen].sum() / max(directions.weights.sum(), 1e-9)
        return modes._replace(seen=seen, supported=bool(seen.sum() >= 2 and explained >= self.min_explained))

    def peaks(self, modes: Modes, directions: Directions, planes: Planes | None) -> Bool:
        """(m,) whether a plane, enough normals or enough lines stand on each axis, the latter two denser than directions without order would."""
        normals, widest = modes.normals, (self.max_width * self.cone) ** 2
        dense = normals[:, 3] < widest
        if self.use_planes and planes is not None:
            on_axis = np.abs(planes.coefficients[:, :3] @ modes.axes) > np.cos(0.5 * self.cone)
            dense |= on_axis.T @ planes.pixels >= self.min_share * planes.labels.size * planes.stride**2
        enough = normals[:, 1] >= self.min_share * max(directions.first_line, 1)
        return np.asarray(enough & dense | self._line_peaks(modes, directions, widest))

    def _line_peaks(self, modes: Modes, directions: Directions, widest: float) -> Bool:
        """(m,) whether enough lines stand on the axis, and on the axes together more than lines drawn any way on one wall would.

        An axis is measured against the lines that no heavier axis has: a few long ones along a corridor must not outweigh what is across it."""
        lines, length = modes.lines, directions.weights[directions.first_line :]
        on_axis = np.abs(directions.vectors[directions.first_line :] @ modes.axes) > np.cos(self.cone)
        peaks, left = np.zeros(len(lines), np.bool_), np.ones(len(length), np.bool_)
        fit = (lines[:, 0] >= self.min_lines) & (lines[:, 3] < widest)
        for k in sorted(np.flatnonzero(fit), key=lambda k: -lines[k, 1]):
            least = _by_chance(lines[k, 3], self.cone, 2.0 / (np.pi - 2.0 * self.cone), length[left]) if peaks.any() else 0.0
            peaks[k] = lines[k, 1] >= max(self.min_line_share * float(length[left].sum()), least)
            left &= ~on_axis[:, k]
        # on one wall two axes gather four times their reach of 180° by chance
        return np.asarray(peaks & (lines[peaks, 1].sum() > _by_chance(lines[peaks, 3].max(initial=0.0), self.cone, 4.0 / np.pi, length)))

    def _at_right_angles(self, modes: Modes, peaks: Bool) -> Bool:
        """(3,) the most and heaviest of the peaks that are mutually at right angles, as far as their own uncertainty can tell."""
        fits = self.perpendicular(modes)
        for count in (3, 2, 1):
            sets = [s for s in combinations(np.flatnonzero(peaks), count) if all(fits[i, j] for i, j in combinations(s, 2))]
            if sets:
                return np.isin(np.arange(3), max(sets, key=lambda s: modes.weights[list(s)].sum()))
        return np.zeros(3, np.bool_)

    def perpendicular(self, modes: Modes) -> Bool:
        """(m, m) whether two modes are at right angles, as far as their own uncertainty can tell."""
        sigma = np.sqrt(modes.mean_squares / (2.0 * modes.independent))
        skew = np.abs(np.arcsin(np.clip(modes.axes.T @ modes.axes, -1.0, 1.0)))
        return np.asarray(skew <= self.max_skew + 2.0 * np.hypot(sigma[:, None], sigma[None]))


def _by_chance(mean_square: float, cone: float, per_reach: float, length: F64) -> float:
    """The length that lines (n,) without order have within reach of an axis, give or take 3 sigma; reach is 3 standard deviations of those on it."""
    share = per_reach * float(np.clip(3.0 * np.sqrt(mean_square), np.radians(2.0), cone))
    return float(share * length.sum() + 3.0 * np.sqrt(share * (1.0 - share) * (length * length).sum()))
