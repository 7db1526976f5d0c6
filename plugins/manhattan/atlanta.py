"""An Atlanta world: one vertical, and horizontal directions at any angles to each other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, I32, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.numerics.axes.atlanta_fit import fit_shared_vertical, shared_covariance, shared_vertical
from trihedron.plugins.numerics.axes.atlanta_modes import NONE, AtlantaFinder, AtlantaModes
from trihedron.plugins.numerics.axes.axis_fit import NOTHING_KNOWN, AxisFit, gather_directions, variance_scale
from trihedron.plugins.numerics.axes.frame_identities import missing, remembered
from trihedron.plugins.numerics.axes.manhattan_modes import Directions, ModeFinder
from trihedron.plugins.numerics.axes.several_frames import lost_frames, seen_frames

NOBODY = np.zeros(0, np.int32)


@register("manhattan", "atlanta")
@dataclass(frozen=True)
class Atlanta:
    """One vertical and several pairs of horizontal directions at right angles (Schindler and Dellaert, "Atlanta World", CVPR 2004), by modes instead
    of their expectation–maximisation: of the modes of the sphere, antipodes being one, the vertical is that about which most other directions crowd
    at few azimuths modulo 90°, the inliers that Joo, Oh, Kweon and Bazin ("Globally Optimal Inlier Set Maximization for Atlanta Frame Estimation",
    CVPR 2018) maximise by branch and bound.

    Each azimuth makes a rotation whose third column is the vertical, the same in all; vertical and azimuths are fitted together, so every wall
    helps to hold the vertical upright. A pair keeps its id while it is seen, and out of sight as long as another tells where it must be."""

    cone_deg: float = 12.0  # half-angle of the cone gathered around each axis
    bandwidth_deg: float = 3.0  # of the Gaussian kernel
    samples: int = 1500  # most normals used
    search_samples: int = 500  # and in a search
    line_weight_per_px: float = 0.1  # a line weighs like this many normals per pixel of its length
    max_azimuths: int = 5  # pairs of horizontal directions, seen or remembered
    apart_deg: int = 6  # azimuths nearer than this are one
    min_azimuth: float = 0.04  # of all directions that an azimuth must gather
    again_deg: float = 4.0  # an azimuth found this near to where the others tell it must be is that one
    furthest_deg: float = 20.0  # turn about the vertical since a recent frame
    upright: float = 0.1  # without a previous frame a vertical along the image's counts so much more than one across it
    loyalty: float = 1.2  # another azimuth comes first, or another axis is the vertical, when it has so many times more
    max_age: int = 5  # frames; with an older result the search is from everywhere
    min_share: float = 0.05  # of all normals that an axis must gather
    min_lines: int = 4  # or this many lines,
    min_line_share: float = 0.15  # with this share of the lines' length
    max_width: float = 0.44  # cones, standard deviation of a mode; directions without order have 0.5 and more
    min_explained: float = 0.3  # share of all directions on the axes
    max_skew_deg: float = 3.0  # a mode further from a right angle to the vertical is not horizontal
    fit_deg: float = 6.0  # planes and lines this near to an axis refine it
    plane_floor_deg: float = 0.3  # a wall's deviation from the axis
    line_floor_deg: float = 0.5  # an edge's
    normals_floor_deg: float = 0.5  # error of an axis however many normals it has
    floor_deg: float = 0.05  # of every rotation
    gate: float = 2.0  # σ at which a plane or line counts half

    def __post_init__(self) -> None:
        if not 1.0 <= self.cone_deg <= 30.0 or not 0.1 <= self.bandwidth_deg <= self.cone_deg:
            raise ValueError("cone_deg, bandwidth_deg: cone_deg must be 1 to 30 and bandwidth_deg 0.1 to cone_deg")
        if min(self.samples, self.search_samples) < 10 or min(self.max_azimuths, self.max_age, self.min_lines) < 1 or not 4 <= self.apart_deg <= 30:
            raise ValueError("samples, search_samples, max_azimuths, max_age, min_lines, apart_deg: at least 10, 10, 1, 1, 1, and 4 to 30")
        shares = (self.min_azimuth, self.min_share, self.min_line_share, self.max_width, self.min_explained)
        if not all(0.0 <= share <= 1.0 for share in shares) or self.line_weight_per_px < 0.0:
            raise ValueError("min_azimuth, min_share, min_line_share, max_width, min_explained: must be 0 to 1, line_weight_per_px at least 0")
        if min(self.again_deg, self.furthest_deg, self.fit_deg, self.max_skew_deg) <= 0.0 or self.loyalty < 1.0 or self.upright < 0.0:
            raise ValueError("again_deg, furthest_deg, fit_deg, max_skew_deg, loyalty, upright: must be positive, loyalty at least 1")
        _ = self._fit  # checks its own fields

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """Rotations with one vertical as their third column, the best supported first, then those known but out of sight: without inliers, with a
        covariance that says nothing. `supported` is False when no horizontal direction stands at right angles to the vertical or to another."""
        directions = gather_directions(normals.normals, segments, self.samples, self.line_weight_per_px)
        recent = previous is not None and previous.supported and normals.index - previous.index <= self.max_age
        known, ids = self._known(directions, previous, recent)
        modes = self._atlanta.near(directions, planes, known) if recent else NONE
        if not modes.supported:
            modes = self._atlanta.search(directions, planes, None if previous is None else known)
        if not modes.supported:
            return lost_frames(self._atlanta.finder.follow(directions, planes, known[0]), self._fit, segments, planes, normals, known, ids)
        rotations, covariance = self._fitted(modes, segments, planes)
        order = np.argsort(-modes.weights * np.where(modes.rows == 0, self.loyalty, 1.0), kind="stable")
        rows, rotations = modes.rows[order], rotations[order]
        unseen = remembered(missing(rows, len(known)), ids, self.max_azimuths - len(rows)) if previous is not None else NOBODY
        expected = _beside(rotations, rows, known, unseen)
        return seen_frames(normals, rotations, covariance[order], modes.inliers[order], modes.spread[order], rows, ids, unseen, expected)

    def _known(self, directions: Directions, previous: ManhattanFrame | None, recent: bool) -> tuple[F64, I32]:
        """The rotations (k, 3, 3) known and their ids; while a single one is in view another of its axes may turn out to be the vertical."""
        known, ids = _sharing(previous)
        alone = previous is not None and np.count_nonzero(previous.inliers.any(axis=1)) == 1
        return self._atlanta.better_vertical(directions, known, ids) if alone and recent else (known, ids)

    def _fitted(self, modes: AtlantaModes, segments: Segments, planes: Planes) -> tuple[F64, F64]:
        """(k, 3, 3) rotations fitted together to all that stands on the axes seen, and the covariance of phi of each."""
        count = len(modes.rows)
        vertical = np.arange(3 * count) % 3 == 2
        normals = np.where((vertical & (np.arange(3 * count) > 2))[:, None], 0.0, modes.normals)  # one vertical counts once
        R = np.concatenate(list(modes.rotations), axis=1)
        vectors, information, columns = self._fit.measured(R, modes.axes, normals, segments, planes)
        columns[(columns >= 0) & ~modes.seen[columns]] = -1
        rotations, H, chi2, components = fit_shared_vertical(
            vectors, information, columns, len(vectors) - 3 * count, modes.rotations, 1e-6, self.gate, 5
        )
        scale = variance_scale(chi2, components - 2.0 - count)
        return rotations, shared_covariance(H / scale, rotations, NOTHING_KNOWN) + np.eye(3) * np.radians(self.floor_deg) ** 2

    @cached_property
    def _atlanta(self) -> AtlantaFinder:
        finder = ModeFinder(
            cone=np.radians(self.cone_deg),
            bandwidth=np.radians(self.bandwidth_deg),
            max_iterations=20,
            tolerance=np.radians(1e-3),
            min_share=self.min_share,
            min_lines=self.min_lines,
            min_line_share=self.min_line_share,
            max_width=self.max_width,
            min_explained=self.min_explained,
            max_skew=np.radians(self.max_skew_deg),
            use_planes=True,
        )
        again, furthest = np.radians([self.again_deg, self.furthest_deg])
        return AtlantaFinder(
            finder, self.apart_deg, self.min_azimuth, self.max_azimuths, self.search_samples, self.upright, self.loyalty, again, furthest
        )

    @cached_property
    def _fit(self) -> AxisFit:
        return AxisFit(self.fit_deg, self.normals_floor_deg, self.plane_floor_deg, self.line_floor_deg, self.floor_deg, self.gate)


def _sharing(previous: ManhattanFrame | None) -> tuple[F64, I32]:
    """Rotations (k, 3, 3) of the previous result with the first one's vertical, and their ids (k,)."""
    if previous is None:
        return np.eye(3)[None], np.zeros(1, np.int32)
    vertical = previous.rotations[:, :, 2]
    same = vertical @ vertical[0] > 1.0 - 1e-9  # another estimator's frames need not have it
    return previous.rotations[same], previous.ids[same]


def _beside(rotations: F64, rows: I32, known: F64, unseen: I32) -> F64:
    """(u, 3, 3) where those of the `known` that are out of sight must be: turned like the first one seen again, with the vertical of all."""
    again = int(np.argmax(rows >= 0))
    turn = rotations[again] @ known[max(rows[again], 0)].T
    return np.array([shared_vertical(rotations[again], turn @ R) for R in known[unseen]]).reshape(-1, 3, 3)
