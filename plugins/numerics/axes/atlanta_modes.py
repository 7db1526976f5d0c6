"""When modes of the sphere are one vertical and horizontal directions about it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.types import F64, I32, Bool, Planes
from trihedron.plugins.numerics.axes.axis_fit import HALF_SPHERE
from trihedron.plugins.numerics.axes.azimuth_modes import azimuth_modes, named_azimuths
from trihedron.plugins.numerics.axes.manhattan_modes import Directions, ModeFinder, Modes
from trihedron.plugins.numerics.axes.sphere_modes import densest, mode_statistics, shift_axes

CROSSED = 4  # of the densest directions whose cross products may be the vertical
UP = np.array([0.0, -1.0, 0.0])  # in the image


class AtlantaModes(NamedTuple):
    """k pairs of horizontal directions about one vertical; all but `rotations` by axis, those of a rotation one after another, 3k in all."""

    rotations: F64  # (k, 3, 3), named; the third columns are the same
    rows: I32  # (k,) of the known rotations that they are, -1 for none
    axes: F64  # (3, 3k) the modes themselves
    normals: F64  # (3k, 4) statistics of the normals about them, see `mode_statistics`
    lines: F64  # (3k, 4)
    seen: Bool  # (3k,)

    @property
    def supported(self) -> bool:
        """Whether there is any."""
        return len(self.rows) > 0

    @property
    def weights(self) -> F64:
        """(k,) of the directions on the horizontal axes seen."""
        return np.asarray(((self.normals[:, 1] + self.lines[:, 1]) * self.seen).reshape(-1, 3)[:, :2].sum(axis=1))

    @property
    def inliers(self) -> F64:
        """(k, 3) directions on each axis seen."""
        return np.where(self.seen, self.normals[:, 0] + self.lines[:, 0], 0.0).reshape(-1, 3)

    @property
    def spread(self) -> F64:
        """(k, 3) rad; NaN of axes that are not seen."""
        weight, square = (self.normals[:, 1] + self.lines[:, 1], self.normals[:, 1] * self.normals[:, 2] + self.lines[:, 1] * self.lines[:, 2])
        return np.where(self.seen, np.sqrt(square / np.maximum(weight, 1e-9)), np.nan).reshape(-1, 3)


NONE = AtlantaModes(np.zeros((0, 3, 3)), np.zeros(0, np.int32), np.zeros((3, 0)), np.zeros((0, 4)), np.zeros((0, 4)), np.zeros(0, np.bool_))


@dataclass(frozen=True)
class AtlantaFinder:
    """The rules of `atlanta.Atlanta`, whose fields these are; angles in rad, `apart` in degrees."""

    finder: ModeFinder
    apart: int
    min_azimuth: float
    max_azimuths: int
    search_samples: int
    upright: float
    loyalty: float
    again: float
    furthest: float

    def near(self, directions: Directions, planes: Planes, known: F64) -> AtlantaModes:
        """About the vertical of the known rotations (k, 3, 3), where mean shift takes it."""
        vertical = self._shifted(directions, known[0, :, 2:])[:, 0]
        return self._about(directions, planes, vertical, known, self.furthest)

    def better_vertical(self, directions: Directions, known: F64, ids: I32) -> tuple[F64, I32]:
        """The known rotations (k, 3, 3) and their ids; only the first, with another of its axes as the vertical, when azimuths about that gather
        clearly more: which axis is the vertical cannot be told while all that is seen is at right angles."""
        few = directions.thinned(self.search_samples)
        scores = [self._score(few, v, False) for v in self._shifted(few, known[0]).T]
        best = int(np.argmax(scores))
        if best == 2 or scores[best] <= self.loyalty * scores[2]:
            return known, ids
        return known[:1, :, [(best + 1) % 3, (best + 2) % 3, best]], ids[:1]

    def search(self, directions: Directions, planes: Planes, known: F64 | None) -> AtlantaModes:
        """About the direction that makes most of the others vertical or horizontal, known or not."""
        few = directions.thinned(self.search_samples)
        starts = densest(few.vectors, few.weights, HALF_SPHERE, self.finder.cone, 6)
        if len(starts) == 0:
            return NONE
        modes = self._shifted(few, np.ascontiguousarray(starts.T))
        crossed = [np.cross(modes[:, i], modes[:, j]) for i, j in combinations(range(min(modes.shape[1], CROSSED)), 2)]
        crossed = [c / np.linalg.norm(c) for c in crossed if np.linalg.norm(c) > 0.5]
        vertical = max([*modes.T, *crossed], key=lambda v: self._score(few, v, known is None))
        return self._about(directions, planes, vertical, known, np.pi)

    def _score(self, directions: Directions, vertical: F64, alone: bool) -> float:
        """Weight that the vertical and the azimuths about it gather; upright counts more where nothing else says which is the vertical."""
        on_vertical = np.abs(directions.vectors @ vertical) > np.cos(self.finder.cone)
        masses = self._azimuths(directions, vertical)[1]
        explained = float(directions.weights[on_vertical].sum() + masses.sum())
        return explained * (1.0 + self.upright * alone * abs(float(vertical @ UP)))

    def _azimuths(self, directions: Directions, vertical: F64) -> tuple[F64, F64]:
        least = self.min_azimuth * float(directions.weights.sum())
        vertical = np.ascontiguousarray(vertical)
        return azimuth_modes(*directions, vertical, self.finder.cone, self.apart, self.max_azimuths, least)

    def _shifted(self, directions: Directions, axes: F64) -> F64:
        f = self.finder
        return shift_axes(directions.vectors, directions.weights, axes, f.cone, f.bandwidth, f.max_iterations, f.tolerance)

    def _about(self, directions: Directions, planes: Planes, vertical: F64, known: F64 | None, furthest: float) -> AtlantaModes:
        """The azimuths about a vertical, named, and those of them that are seen."""
        rotations, _ = self._azimuths(directions, vertical)
        if len(rotations) == 0:
            return NONE
        up = np.sign(vertical @ UP) or 1.0
        known = rotations[:1] @ np.diag([1.0, up, up]) if known is None else known
        rotations, rows = named_azimuths(rotations, known, self.again, furthest)
        return self._judged(directions, planes, rotations, rows)

    def _judged(self, directions: Directions, planes: Planes, rotations: F64, rows: I32) -> AtlantaModes:
        """The rotations with a horizontal axis that is a peak of its own at right angles to the vertical; none without a vertical, be it seen or at
        right angles to two that are, or when all together explain too little."""
        vectors, weights, first = directions
        columns = [2] + [3 * k + j for k in range(len(rotations)) for j in (0, 1)]
        axes = self._shifted(directions, np.concatenate(list(rotations), axis=1)[:, columns])
        normals = mode_statistics(vectors[:first], weights[:first], axes, self.finder.cone)
        lines = mode_statistics(vectors[first:], weights[first:], axes, self.finder.cone)
        modes = Modes(axes, normals, lines, np.zeros(len(columns), np.bool_), False)
        seen = self.finder.peaks(modes, directions, planes)
        seen = self._horizontal(modes, seen, float(weights.sum()))
        explained = modes.weights[seen].sum() / max(float(weights.sum()), 1e-9)
        kept = np.flatnonzero(seen[1:].reshape(-1, 2).any(axis=1))
        if len(kept) == 0 or explained < self.finder.min_explained:
            return NONE
        if not seen[0]:
            pair = kept[seen[1:].reshape(-1, 2)[kept].all(axis=1)][0]
            axes[:, 0] = np.cross(axes[:, 1 + 2 * pair], axes[:, 2 + 2 * pair])
        order = kept[np.argsort(-(modes.weights * seen)[1:].reshape(-1, 2)[kept].sum(axis=1), kind="stable")]
        chosen = np.array([[1 + 2 * k, 2 + 2 * k, 0] for k in order]).ravel()
        upright = np.array([_rotation(axes[:, 0], axes[:, 1 + 2 * k : 3 + 2 * k], (modes.weights * seen)[1 + 2 * k : 3 + 2 * k]) for k in order])
        return AtlantaModes(upright, rows[order], axes[:, chosen], normals[chosen], lines[chosen], seen[chosen])

    def _horizontal(self, modes: Modes, peaks: Bool, total: float) -> Bool:
        """(m,) the vertical, first, if it is a peak, and the peaks at right angles to it and to their partners, no two at one azimuth."""
        axes, weights = modes.axes.copy(), modes.weights
        fits = self.finder.perpendicular(modes)
        pairs = [k for k in range(1, len(peaks), 2) if peaks[k] and peaks[k + 1] and fits[k, k + 1]]
        if not peaks[0]:
            if not pairs:
                return np.zeros(len(peaks), np.bool_)
            best = max(pairs, key=lambda k: weights[k] + weights[k + 1])
            axes[:, 0] = np.cross(axes[:, best], axes[:, best + 1])
            fits = self.finder.perpendicular(modes._replace(axes=axes))
        seen = peaks & fits[0]
        seen[0] = peaks[0]
        for k in range(1, len(peaks), 2):
            if seen[k] and seen[k + 1] and not fits[k, k + 1]:
                seen[k if weights[k] < weights[k + 1] else k + 1] = False
        taken = np.zeros((3, 0))
        for k in sorted(range(1, len(peaks), 2), key=lambda k: -(weights[k] * seen[k] + weights[k + 1] * seen[k + 1])):
            own = seen[k : k + 2]
            alone = (np.abs(axes[:, k : k + 2].T @ taken) < np.cos(np.radians(self.apart) * 0.7)).all(axis=1)
            if not alone[own].all() or weights[k : k + 2][own].sum() < self.min_azimuth * total:
                own[:] = False
            taken = np.concatenate([taken, axes[:, k : k + 2][:, own]], axis=1)
        return np.asarray(seen)


def _rotation(vertical: F64, pair: F64, weights: F64) -> F64:
    """(3, 3) with third column `vertical` and the first two nearest to a pair of horizontal axes (3, 2), by weight (2,)."""
    vertical = vertical / np.linalg.norm(vertical)
    first = weights[0] * pair[:, 0] + weights[1] * np.cross(pair[:, 1], vertical)
    first -= (first @ vertical) * vertical
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(vertical, first), vertical], axis=1)
