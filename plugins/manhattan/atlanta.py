"""An Atlanta world: one vertical, and horizontal directions at any angles to each other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.linalg import inv, matmul, norm
from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, PositiveInt, Range, Share, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, Bool, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.manhattan.atlanta_kernels import QUARTER, azimuth_modes, fit_shared_vertical, shared_vertical
from trihedron.plugins.manhattan.axis_fit import fit_rules, measure_directions
from trihedron.plugins.manhattan.axis_fit_kernels import NOTHING_KNOWN, FitRules, variance_scale
from trihedron.plugins.manhattan.directions import HALF_SPHERE, Directions, gather_directions
from trihedron.plugins.manhattan.frame_association import lost_frames, retain_unseen, seen_frames, unmatched_rows
from trihedron.plugins.manhattan.mean_shift_kernels import densest, mode_statistics, shift_axes
from trihedron.plugins.manhattan.modes import Modes, find_peaks, mode_limits, perpendicular_modes, shift_limits, track_modes

NOBODY = np.zeros(0, np.int32)
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
        """Return True if there is any."""
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


@register("manhattan", "atlanta")
@dataclass(frozen=True)
class Atlanta:
    """One vertical and several pairs of horizontal directions at right angles (Schindler and Dellaert, "Atlanta World", CVPR 2004), by modes instead
    of their expectation–maximisation: of the modes of the sphere, antipodes being one, the vertical is that about which most other directions crowd
    at few azimuths modulo 90°, the inliers that Joo, Oh, Kweon and Bazin ("Globally Optimal Inlier Set Maximization for Atlanta Frame Estimation",
    CVPR 2018) maximise by branch and bound.

    Each azimuth makes a rotation whose third column is the vertical, the same in all; vertical and azimuths are fitted together, so every wall
    helps to hold the vertical upright. A pair keeps its id while it is seen, and out of sight as long as another determines its direction."""

    cone_deg: Annotated[float, Range(1, 30)] = 12.0  # half-angle of the cone gathered around each axis
    bandwidth_deg: Annotated[float, Range(0.1, 30)] = 3.0  # of the Gaussian kernel
    samples: Annotated[int, Range(10)] = 1500  # most normals used
    search_samples: Annotated[int, Range(10)] = 500  # and in a search
    line_weight_per_px: NonNegativeFloat = 0.1  # a line weighs like this many normals per pixel of its length
    max_azimuths: PositiveInt = 5  # pairs of horizontal directions, seen or remembered
    apart_deg: Annotated[int, Range(4, 30)] = 6  # azimuths nearer than this are one
    min_azimuth: Share = 0.04  # of all directions that an azimuth must gather
    again_deg: PositiveFloat = 4.0  # an azimuth found this near to where the others tell it must be is that one
    furthest_deg: PositiveFloat = 20.0  # turn about the vertical since a recent frame
    upright: NonNegativeFloat = 0.1  # without a previous frame a vertical along the image's counts so much more than one across it
    loyalty: Annotated[float, Range(1)] = 1.2  # another azimuth comes first, or another axis is the vertical, when it has so many times more
    max_age: PositiveInt = 5  # frames; with an older result the search is from everywhere
    min_share: Share = 0.05  # of all normals that an axis must gather
    min_lines: PositiveInt = 4  # or this many lines,
    min_line_share: Share = 0.15  # with this share of the lines' length
    max_width: Share = 0.44  # cones, standard deviation of a mode; directions without order have 0.5 and more
    min_explained: Share = 0.3  # share of all directions on the axes
    max_skew_deg: PositiveFloat = 3.0  # a mode further from a right angle to the vertical is not horizontal
    fit_deg: PositiveFloat = 6.0  # planes and lines this near to an axis refine it
    plane_floor_deg: PositiveFloat = 0.3  # a wall's deviation from the axis
    line_floor_deg: PositiveFloat = 0.5  # an edge's
    normals_floor_deg: PositiveFloat = 0.5  # error of an axis however many normals it has
    floor_deg: PositiveFloat = 0.05  # of every rotation
    gate: PositiveFloat = 2.0  # σ at which a plane or line counts half

    max_iterations: ClassVar[int] = 20  # of mean shift
    tolerance_deg: ClassVar[float] = 1e-3
    use_planes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_increasing(self, "bandwidth_deg", "cone_deg")

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """Rotations with one vertical as their third column, the best supported first, then those known but out of sight: without inliers, with a
        uninformative covariance. `supported` is False when no horizontal direction stands at right angles to the vertical or to another."""
        directions = gather_directions(normals.normals, segments, self.samples, self.line_weight_per_px)
        recent = previous is not None and previous.supported and normals.index - previous.index <= self.max_age
        known, ids = self._known_rotations(directions, previous, recent)
        modes = self._near(directions, planes, known) if recent else NONE
        if not modes.supported:
            modes = self._search(directions, planes, None if previous is None else known)
        if not modes.supported:
            return lost_frames(track_modes(self, directions, planes, known[0]), self._rules, segments, planes, normals, known, ids)
        rotations, covariance = self._fit(modes, segments, planes)
        order = np.argsort(-modes.weights * np.where(modes.rows == 0, self.loyalty, 1.0), kind="stable")
        rows, rotations = modes.rows[order], rotations[order]
        unseen = retain_unseen(unmatched_rows(rows, len(known)), ids, self.max_azimuths - len(rows)) if previous is not None else NOBODY
        expected = _predict_unseen(rotations, rows, known, unseen)
        return seen_frames(normals, rotations, covariance[order], modes.inliers[order], modes.spread[order], rows, ids, unseen, expected)

    def _known_rotations(self, directions: Directions, previous: ManhattanFrame | None, recent: bool) -> tuple[F64, I32]:
        """Return the known rotations (k, 3, 3) and their ids; while a single one is in view another of its axes may turn out to be the vertical."""
        known, ids = _with_first_vertical(previous)
        alone = previous is not None and np.count_nonzero(previous.inliers.any(axis=1)) == 1
        return self._better_vertical(directions, known, ids) if alone and recent else (known, ids)

    def _fit(self, modes: AtlantaModes, segments: Segments, planes: Planes) -> tuple[F64, F64]:
        """Fit the rotations (k, 3, 3) together to all that lies on the axes seen; return them with the covariance of phi of each."""
        count = len(modes.rows)
        vertical = np.arange(3 * count) % 3 == 2
        normals = np.where((vertical & (np.arange(3 * count) > 2))[:, None], 0.0, modes.normals)  # one vertical counts once
        R = np.concatenate(list(modes.rotations), axis=1)
        vectors, information, columns = measure_directions(self._rules, R, modes.axes, normals, segments, planes)
        columns[(columns >= 0) & ~modes.seen[columns]] = -1
        rotations, H, chi2, components = fit_shared_vertical(
            vectors, information, columns, len(vectors) - 3 * count, modes.rotations, 1e-6, self.gate, 5
        )
        scale = variance_scale(chi2, components - 2.0 - count)
        return rotations, shared_covariance(H / scale, rotations, NOTHING_KNOWN) + np.eye(3) * np.radians(self.floor_deg) ** 2

    def _near(self, directions: Directions, planes: Planes, known: F64) -> AtlantaModes:
        """Find the azimuths about the vertical of the known rotations (k, 3, 3), tracked by mean shift."""
        vertical = self._shift(directions, known[0, :, 2:])[:, 0]
        return self._about(directions, planes, vertical, known, np.radians(self.furthest_deg))

    def _better_vertical(self, directions: Directions, known: F64, ids: I32) -> tuple[F64, I32]:
        """Return the known rotations (k, 3, 3) and their ids; only the first, with another of its axes as the vertical, when azimuths about that
        gather clearly more: which axis is the vertical cannot be decided while all that is seen is at right angles."""
        few = directions.subsample(self.search_samples)
        scores = [self._score(few, v, False) for v in self._shift(few, known[0]).T]
        best = int(np.argmax(scores))
        if best == 2 or scores[best] <= self.loyalty * scores[2]:
            return known, ids
        return known[:1, :, [(best + 1) % 3, (best + 2) % 3, best]], ids[:1]

    def _search(self, directions: Directions, planes: Planes, known: F64 | None) -> AtlantaModes:
        """Find the azimuths about the direction that makes most of the others vertical or horizontal, known or not."""
        few = directions.subsample(self.search_samples)
        starts = densest(few.vectors, few.weights, HALF_SPHERE, np.radians(self.cone_deg), 6)
        if len(starts) == 0:
            return NONE
        modes = self._shift(few, np.ascontiguousarray(starts.T))
        crossed = [np.cross(modes[:, i], modes[:, j]) for i, j in combinations(range(min(modes.shape[1], CROSSED)), 2)]
        crossed = [c / norm(c) for c in crossed if norm(c) > 0.5]
        vertical = max([*modes.T, *crossed], key=lambda v: self._score(few, v, known is None))
        return self._about(directions, planes, vertical, known, np.pi)

    def _score(self, directions: Directions, vertical: F64, alone: bool) -> float:
        """Return the weight that the vertical and the azimuths about it gather; upright counts more where nothing else determines the vertical."""
        on_vertical = np.abs(matmul(directions.vectors, vertical)) > np.cos(np.radians(self.cone_deg))
        masses = self._azimuths(directions, vertical)[1]
        explained = float(directions.weights[on_vertical].sum() + masses.sum())
        return explained * (1.0 + self.upright * alone * abs(float(matmul(vertical, UP))))

    def _azimuths(self, directions: Directions, vertical: F64) -> tuple[F64, F64]:
        least = self.min_azimuth * float(directions.weights.sum())
        vertical = np.ascontiguousarray(vertical)
        return azimuth_modes(*directions, vertical, np.radians(self.cone_deg), self.apart_deg, self.max_azimuths, least)

    def _shift(self, directions: Directions, axes: F64) -> F64:
        return shift_axes(directions.vectors, directions.weights, axes, *shift_limits(self))

    def _about(self, directions: Directions, planes: Planes, vertical: F64, known: F64 | None, furthest: float) -> AtlantaModes:
        """Find the azimuths about a vertical, name and verify them."""
        rotations, _ = self._azimuths(directions, vertical)
        if len(rotations) == 0:
            return NONE
        up = np.sign(matmul(vertical, UP)) or 1.0
        known = matmul(rotations[:1], np.diag([1.0, up, up])) if known is None else known
        rotations, rows = match_azimuths(rotations, known, np.radians(self.again_deg), furthest)
        return self._verify(directions, planes, rotations, rows)

    def _verify(self, directions: Directions, planes: Planes, rotations: F64, rows: I32) -> AtlantaModes:
        """The rotations with a horizontal axis that is a peak of its own at right angles to the vertical; none without a vertical, be it seen or at
        right angles to two that are, or when all together explain too little."""
        vectors, weights, first = directions
        columns = [2] + [3 * k + j for k in range(len(rotations)) for j in (0, 1)]
        axes = self._shift(directions, np.concatenate(list(rotations), axis=1)[:, columns])
        normals = mode_statistics(vectors[:first], weights[:first], axes, np.radians(self.cone_deg))
        lines = mode_statistics(vectors[first:], weights[first:], axes, np.radians(self.cone_deg))
        modes = Modes(axes, normals, lines, np.zeros(len(columns), np.bool_), False)
        seen = find_peaks(mode_limits(self), modes, directions, planes)
        seen = self._horizontal(modes, seen, float(weights.sum()))
        explained = modes.weights[seen].sum() / max(float(weights.sum()), 1e-9)
        kept = np.flatnonzero(seen[1:].reshape(-1, 2).any(axis=1))
        if len(kept) == 0 or explained < self.min_explained:
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
        fits = perpendicular_modes(mode_limits(self), modes)
        pairs = [k for k in range(1, len(peaks), 2) if peaks[k] and peaks[k + 1] and fits[k, k + 1]]
        if not peaks[0]:
            if not pairs:
                return np.zeros(len(peaks), np.bool_)
            best = max(pairs, key=lambda k: weights[k] + weights[k + 1])
            axes[:, 0] = np.cross(axes[:, best], axes[:, best + 1])
            fits = perpendicular_modes(mode_limits(self), modes._replace(axes=axes))
        seen = peaks & fits[0]
        seen[0] = peaks[0]
        for k in range(1, len(peaks), 2):
            if seen[k] and seen[k + 1] and not fits[k, k + 1]:
                seen[k if weights[k] < weights[k + 1] else k + 1] = False
        taken = np.zeros((3, 0))
        for k in sorted(range(1, len(peaks), 2), key=lambda k: -(weights[k] * seen[k] + weights[k + 1] * seen[k + 1])):
            own = seen[k : k + 2]
            alone = (np.abs(matmul(axes[:, k : k + 2].T, taken)) < np.cos(np.radians(self.apart_deg) * 0.7)).all(axis=1)
            if not alone[own].all() or weights[k : k + 2][own].sum() < self.min_azimuth * total:
                own[:] = False
            taken = np.concatenate([taken, axes[:, k : k + 2][:, own]], axis=1)
        return np.asarray(seen)

    @cached_property
    def _rules(self) -> FitRules:
        return fit_rules(self, self.fit_deg, self.normals_floor_deg, self.gate)


def _with_first_vertical(previous: ManhattanFrame | None) -> tuple[F64, I32]:
    """Return the rotations (k, 3, 3) of the previous result with the first one's vertical, and their ids (k,)."""
    if previous is None:
        return np.eye(3)[None], np.zeros(1, np.int32)
    vertical = previous.rotations[:, :, 2]
    same = matmul(vertical, vertical[0]) > 1.0 - 1e-9  # another estimator's frames need not have it
    return previous.rotations[same], previous.ids[same]


def _predict_unseen(rotations: F64, rows: I32, known: F64, unseen: I32) -> F64:
    """Predict those of the `known` that are out of sight, (u, 3, 3): rotated like the first one seen again, with the vertical of all."""
    again = int(np.argmax(rows >= 0))
    turn = matmul(rotations[again], known[max(rows[again], 0)].T)
    return np.array([shared_vertical(rotations[again], matmul(turn, R)) for R in known[unseen]]).reshape(-1, 3, 3)


def _rotation(vertical: F64, pair: F64, weights: F64) -> F64:
    """(3, 3) with third column `vertical` and the first two nearest to a pair of horizontal axes (3, 2), by weight (2,)."""
    vertical = vertical / norm(vertical)
    first = weights[0] * pair[:, 0] + weights[1] * np.cross(pair[:, 1], vertical)
    first -= matmul(first, vertical) * vertical
    first /= norm(first)
    return np.stack([first, np.cross(vertical, first), vertical], axis=1)


def match_azimuths(found: F64, known: F64, limit: float, furthest: float) -> tuple[F64, I32]:
    """The rotations found (f, 3, 3) with their columns named like those of the known ones (k, 3, 3) that they are, and the rows (f,) of these, -1 for
    none; each set shares its third columns.

    The known ones keep their angles to each other: they are turned so that most of them are found within `limit` (rad), by no more than `furthest`
    when that finds any, and by the least of such turns."""
    flip = np.diag([1.0, -1.0, -1.0]) if matmul(found[0, :, 2], known[0, :, 2]) < 0.0 else np.eye(3)
    found = matmul(found, flip)
    azimuth = _azimuths(found, found[0])
    expected = _azimuths(_tilt_to(known, found[0, :, 2]), found[0])
    apart = _wrap_quarter(azimuth[:, None] - expected[None])
    turns = apart.ravel()
    matched = np.abs(_wrap_quarter(apart[None] - turns[:, None, None])) <= limit
    number = np.minimum(matched.any(axis=1).sum(axis=1), matched.any(axis=2).sum(axis=1))
    near = np.abs(turns) <= furthest
    turn = turns[np.lexsort((np.abs(turns), -number, ~near))[0]]
    off = np.abs(_wrap_quarter(apart - turn))
    rows = np.full(len(found), -1, np.int32)
    while off.min() <= limit:
        f, k = np.unravel_index(int(np.argmin(off)), off.shape)
        rows[f] = k
        off[f], off[:, k] = np.inf, np.inf
    steps = np.round((expected[np.maximum(rows, 0)] + turn - azimuth) / QUARTER) * QUARTER
    return np.array([matmul(exp_so3(step * R[:, 2]), R) for step, R in zip(steps, found)]), rows


def _azimuths(rotations: F64, base: F64) -> F64:
    """(k,) turn of the first column of each about the third of `base` (rad)."""
    return np.asarray(np.arctan2(matmul(rotations[:, :, 0], base[:, 1]), matmul(rotations[:, :, 0], base[:, 0])))


def _wrap_quarter(angles: F64) -> F64:
    """Wrap angles to -45° … 45°."""
    return np.asarray(angles - np.round(angles / QUARTER) * QUARTER)


def _tilt_to(rotations: F64, vertical: F64) -> F64:
    """(k, 3, 3) with their common third column turned onto `vertical` the shortest way."""
    axis = np.cross(rotations[0, :, 2], vertical)
    sine, cosine = float(norm(axis)), float(matmul(rotations[0, :, 2], vertical))
    return rotations if sine < 1e-12 else matmul(exp_so3(axis / sine * np.arctan2(sine, cosine)), rotations)


def shared_covariance(H: F64, rotations: F64, unknown: float) -> F64:
    """(k, 3, 3) covariance of phi in `R <- Exp(phi) R` of each rotation, from the information H (2 + k, 2 + k) of `fit_shared_vertical`; `unknown`
    (rad²) is the variance of what is not observed."""
    joint = inv(H + np.eye(len(H)) / unknown)
    out = np.empty((len(rotations), 3, 3))
    for f in range(len(rotations)):
        rows = [0, 1, 2 + f]
        out[f] = matmul(rotations[0], joint[np.ix_(rows, rows)], rotations[0].T)
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))
