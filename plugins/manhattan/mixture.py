"""Several Manhattan frames in one scene, known again from image to image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.numerics.axes.axis_fit import AxisFit, gather_directions
from trihedron.plugins.numerics.axes.cube_symmetry import nearest_equivalent
from trihedron.plugins.numerics.axes.frame_identities import identified, missing, remembered, turn_between
from trihedron.plugins.numerics.axes.frame_mixture import Found, FrameMixture
from trihedron.plugins.numerics.axes.manhattan_modes import ModeFinder
from trihedron.plugins.numerics.axes.several_frames import lost_frames, mode_spread, seen_frames

NOBODY = np.zeros(0, np.int32)


@register("manhattan", "mixture")
@dataclass(frozen=True)
class Mixture:
    """A mixture of Manhattan frames (Straub, Rosman, Freifeld, Leonard and Fisher, CVPR 2014): every direction belongs to the nearest axis of all
    frames, every frame is re-estimated from its own; instead of random splits and merges, what no frame explains is searched for another.

    Frames may share an axis (two blocks of walls on one floor), but each needs one of its own. A frame keeps its id while it is seen, while another
    is seen that tells where it must be, and through a jump of the camera that leaves several in view."""

    cone_deg: float = 12.0  # half-angle of the cone gathered around each axis
    bandwidth_deg: float = 4.0  # of the Gaussian kernel
    samples: int = 1500  # most normals used
    search_samples: int = 500  # and in a search
    line_weight_per_px: float = 0.1  # a line weighs like this many normals per pixel of its length
    max_frames: int = 4
    min_own: float = 0.06  # of all directions that a frame must have on axes which are not a better frame's
    shared_deg: float = 4.0  # axes nearer than this are the same one
    merge_deg: float = 6.0  # frames nearer than this are the same one
    again_deg: float = 10.0  # a frame found this near to where others tell it must be is that one; twice that without others
    loyalty: float = 1.2  # another frame comes first when it has so many times more than the one that did
    max_age: int = 5  # frames; with an older result the search is from everywhere
    min_share: float = 0.05  # of its normals that an axis must gather
    min_lines: int = 4  # or this many lines,
    min_line_share: float = 0.15  # with this share of the lines' length
    max_width: float = 0.44  # cones, standard deviation of a mode; directions without order have 0.5 and more
    min_explained: float = 0.3  # share of its directions on its axes
    max_skew_deg: float = 3.0  # two modes further from a right angle do not belong to one frame
    fit_deg: float = 6.0  # planes and lines this near to an axis refine it
    plane_floor_deg: float = 0.3  # a wall's deviation from the axis
    line_floor_deg: float = 0.5  # an edge's
    normals_floor_deg: float = 0.5  # error of an axis however many normals it has
    floor_deg: float = 0.05  # of the whole rotation

    def __post_init__(self) -> None:
        if not 1.0 <= self.cone_deg <= 30.0 or not 0.1 <= self.bandwidth_deg <= self.cone_deg:
            raise ValueError("cone_deg, bandwidth_deg: cone_deg must be 1 to 30 and bandwidth_deg 0.1 to cone_deg")
        if min(self.samples, self.search_samples) < 10 or min(self.max_frames, self.max_age, self.min_lines) < 1:
            raise ValueError("samples, search_samples, max_frames, max_age, min_lines: at least 10, 10, 1, 1 and 1")
        shares = (self.min_own, self.min_share, self.min_line_share, self.max_width, self.min_explained)
        if not all(0.0 <= share <= 1.0 for share in shares) or self.line_weight_per_px < 0.0:
            raise ValueError("min_own, min_share, min_line_share, max_width, min_explained: must be 0 to 1, line_weight_per_px at least 0")
        if min(self.shared_deg, self.merge_deg, self.again_deg, self.fit_deg, self.max_skew_deg) <= 0.0 or self.loyalty < 1.0:
            raise ValueError("shared_deg, merge_deg, again_deg, fit_deg, max_skew_deg, loyalty: must be positive, loyalty at least 1")
        _ = self._fit  # checks its own fields

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """Frames seen, the best supported first, then those known but out of sight: expected from the others, no inliers, a covariance that says
        nothing. `supported` is False when none is seen."""
        directions = gather_directions(normals.normals, segments, self.samples, self.line_weight_per_px)
        known = np.eye(3)[None] if previous is None else previous.rotations
        ids = np.zeros(1, np.int32) if previous is None else previous.ids
        recent = previous is not None and previous.supported and normals.index - previous.index <= self.max_age
        followed = self._frames.followed(directions, planes, known) if recent else []
        found = self._frames.searched(directions, planes, followed)
        turn = self._turn(followed, found, known)
        found = self._recognised(found, turn @ known)
        if not found:
            return lost_frames(self._frames.finder.follow(directions, planes, known[0]), self._fit, segments, planes, normals, known, ids)
        rows = np.array([one.row for one in found], np.int32)
        unseen = remembered(missing(rows, len(known)), ids, self.max_frames - len(found)) if previous is not None else NOBODY
        fits = [self._fit(one.R, one.modes.axes, one.modes.normals, np.ones(3, np.bool_), segments, planes) for one in found]
        rotations, covariance = (np.array(values) for values in zip(*fits))
        if rows.max() >= 0:  # with the fitted rotation, so that what is out of sight keeps its angles to it over many frames
            again = int(np.argmax(rows >= 0))
            turn = rotations[again] @ known[rows[again]].T
        inliers = np.array([one.modes.normals[:, 0] + one.modes.lines[:, 0] for one in found])
        spread = np.array([mode_spread(one.modes) for one in found])
        return seen_frames(normals, rotations, covariance, inliers, spread, rows, ids, unseen, (turn @ known)[unseen])

    def _turn(self, followed: list[Found], found: list[Found], known: F64) -> F64:
        """(3, 3) how the known frames (k, 3, 3) have turned: with the heaviest followed, unless another turn makes more of those found known ones."""
        rotations, limit = np.array([one.R for one in found]).reshape(-1, 3, 3), np.radians(self.again_deg)
        if followed:
            turn = followed[0].R @ known[followed[0].row].T
            matched = (identified(rotations, turn @ known, limit) >= 0).sum()
            if matched >= min(len(found), len(known)):
                return turn
        other = turn_between(rotations, known, limit)
        return turn if followed and matched >= (identified(rotations, other @ known, limit) >= 0).sum() else other

    def _recognised(self, found: list[Found], expected: F64) -> list[Found]:
        """Each with the row of the expected frame (k, 3, 3) that it is, named as this is, in order of support; the one that came first before stays
        there until another has clearly more."""
        rows = identified(np.array([one.R for one in found]).reshape(-1, 3, 3), expected, np.radians(self.again_deg))
        named = [Found(nearest_equivalent(one.R, expected[max(row, 0)]), one.modes, int(row)) for one, row in zip(found, rows)]
        return sorted(named, key=lambda one: -one.weight * (self.loyalty if one.row == 0 else 1.0))

    @cached_property
    def _frames(self) -> FrameMixture:
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
        shared, merge, again = np.radians([self.shared_deg, self.merge_deg, self.again_deg])
        return FrameMixture(finder, shared, merge, again, self.min_own, self.max_frames, self.search_samples)

    @cached_property
    def _fit(self) -> AxisFit:
        return AxisFit(self.fit_deg, self.normals_floor_deg, self.plane_floor_deg, self.line_floor_deg, self.floor_deg)
