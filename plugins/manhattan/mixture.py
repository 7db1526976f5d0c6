"""Several Manhattan frames in one scene, known again from image to image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from trihedron.pipeline.core.lie import rotation_angle_deg
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import NonNegativeFloat, PositiveFloat, PositiveInt, Range, Share, check_increasing
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, Bool, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.manhattan.axis_fit import fit_axes, fit_rules
from trihedron.plugins.manhattan.axis_fit_kernels import orthonormal
from trihedron.plugins.manhattan.directions import HALF_SPHERE, Directions, gather_directions
from trihedron.plugins.manhattan.frame_association import (
    associate_frames,
    camera_rotation,
    lost_frames,
    retain_unseen,
    seen_frames,
    symmetric_angles,
    unmatched_rows,
)
from trihedron.plugins.manhattan.mean_shift_kernels import search_axes
from trihedron.plugins.manhattan.modes import Modes, mode_spread, track_modes
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent

NOBODY = np.zeros(0, np.int32)
SHARED_WEIGHT = 0.2  # what belongs to a known frame may still be an axis of another, but does not lead to one


class Found(NamedTuple):
    """A Manhattan frame seen: its rotation (3, 3), the modes behind it, and which row of the known frames it is (-1: none)."""

    R: F64
    modes: Modes
    row: int

    @property
    def weight(self) -> float:
        """Weight of the directions on its axes."""
        return float(self.modes.weights[self.modes.seen].sum())


@register("manhattan", "mixture")
@dataclass(frozen=True)
class Mixture:
    """A mixture of Manhattan frames (Straub, Rosman, Freifeld, Leonard and Fisher, CVPR 2014): every direction belongs to the nearest axis of all
    frames, every frame is re-estimated from its own; instead of random splits and merges, what no frame explains is searched for another.

    Frames may share an axis (two blocks of walls on one floor), but each needs one of its own. A frame keeps its id while it is seen, while another
    is seen that determines it, and through a jump of the camera that leaves several in view."""

    cone_deg: Annotated[float, Range(1, 30)] = 12.0  # half-angle of the cone gathered around each axis
    bandwidth_deg: Annotated[float, Range(0.1, 30)] = 4.0  # of the Gaussian kernel
    samples: Annotated[int, Range(10)] = 1500  # most normals used
    search_samples: Annotated[int, Range(10)] = 500  # and in a search
    line_weight_per_px: NonNegativeFloat = 0.1  # a line weighs like this many normals per pixel of its length
    max_frames: PositiveInt = 4
    min_own: Share = 0.06  # of all directions that a frame must have on axes which are not a better frame's
    shared_deg: PositiveFloat = 4.0  # axes nearer than this are the same one
    merge_deg: PositiveFloat = 6.0  # frames nearer than this are the same one
    again_deg: PositiveFloat = 10.0  # a frame found this near to where others tell it must be is that one; twice that without others
    loyalty: Annotated[float, Range(1)] = 1.2  # another frame comes first when it has so many times more than the one that did
    max_age: PositiveInt = 5  # frames; with an older result the search is from everywhere
    min_share: Share = 0.05  # of its normals that an axis must gather
    min_lines: PositiveInt = 4  # or this many lines,
    min_line_share: Share = 0.15  # with this share of the lines' length
    max_width: Share = 0.44  # cones, standard deviation of a mode; directions without order have 0.5 and more
    min_explained: Share = 0.3  # share of its directions on its axes
    max_skew_deg: PositiveFloat = 3.0  # two modes further from a right angle do not belong to one frame
    fit_deg: PositiveFloat = 6.0  # planes and lines this near to an axis refine it
    plane_floor_deg: PositiveFloat = 0.3  # a wall's deviation from the axis
    line_floor_deg: PositiveFloat = 0.5  # an edge's
    normals_floor_deg: PositiveFloat = 0.5  # error of an axis however many normals it has
    floor_deg: PositiveFloat = 0.05  # of the whole rotation

    gate: ClassVar[float] = 2.0  # σ at which a plane or line counts half
    max_iterations: ClassVar[int] = 20  # of mean shift
    tolerance_deg: ClassVar[float] = 1e-3
    use_planes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_increasing(self, "bandwidth_deg", "cone_deg")

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """Frames seen, the best supported first, then those known but out of sight: expected from the others, no inliers, an uninformative
        covariance. `supported` is False when none is seen."""
        rules = fit_rules(self, self.fit_deg, self.normals_floor_deg, self.gate)
        directions = gather_directions(normals.normals, segments, self.samples, self.line_weight_per_px)
        known = np.eye(3)[None] if previous is None else previous.rotations
        ids = np.zeros(1, np.int32) if previous is None else previous.ids
        recent = previous is not None and previous.supported and normals.index - previous.index <= self.max_age
        tracked = self._track_known(directions, planes, known) if recent else []
        found = self._search_more(directions, planes, tracked)
        turn = self._camera_rotation(tracked, found, known)
        found = self._name_frames(found, matmul(turn, known))
        if not found:
            return lost_frames(track_modes(self, directions, planes, known[0]), rules, segments, planes, normals, known, ids)
        rows = np.array([one.row for one in found], np.int32)
        unseen = retain_unseen(unmatched_rows(rows, len(known)), ids, self.max_frames - len(found)) if previous is not None else NOBODY
        fits = [fit_axes(rules, one.R, one.modes.axes, one.modes.normals, np.ones(3, np.bool_), segments, planes) for one in found]
        rotations, covariance = (np.array(values) for values in zip(*fits))
        if rows.max() >= 0:  # with the fitted rotation, so that what is out of sight keeps its angles to it over many frames
            again = int(np.argmax(rows >= 0))
            turn = matmul(rotations[again], known[rows[again]].T)
        inliers = np.array([one.modes.normals[:, 0] + one.modes.lines[:, 0] for one in found])
        spread = np.array([mode_spread(one.modes) for one in found])
        return seen_frames(normals, rotations, covariance, inliers, spread, rows, ids, unseen, matmul(turn, known)[unseen])

    def _camera_rotation(self, tracked: list[Found], found: list[Found], known: F64) -> F64:
        """Return the rotation (3, 3) of the known frames (k, 3, 3) since then: by the heaviest tracked, unless another associates more."""
        rotations, limit = np.array([one.R for one in found]).reshape(-1, 3, 3), np.radians(self.again_deg)
        if tracked:
            turn = matmul(tracked[0].R, known[tracked[0].row].T)
            matched = (associate_frames(rotations, matmul(turn, known), limit) >= 0).sum()
            if matched >= min(len(found), len(known)):
                return np.asarray(turn)
        other = camera_rotation(rotations, known, limit)
        return turn if tracked and matched >= (associate_frames(rotations, matmul(other, known), limit) >= 0).sum() else other

    def _name_frames(self, found: list[Found], expected: F64) -> list[Found]:
        """Associate the frames found with those expected (k, 3, 3), name their axes alike, and sort them by support; the one that came first before
        stays there until another has clearly more."""
        rows = associate_frames(np.array([one.R for one in found]).reshape(-1, 3, 3), expected, np.radians(self.again_deg))
        named = [Found(nearest_equivalent(one.R, expected[max(row, 0)]), one.modes, int(row)) for one, row in zip(found, rows)]
        return sorted(named, key=lambda one: -one.weight * (self.loyalty if one.row == 0 else 1.0))

    def _track_known(self, directions: Directions, planes: Planes, known: F64) -> list[Found]:
        """Return the known rotations (k, 3, 3) that the scene still supports nearby, heaviest first. The rotation of the first one found predicts
        those after it."""
        found: list[Found] = []
        expected, again = known, np.radians(self.again_deg)
        for row in range(len(known)):
            modes = self._near(directions, planes, expected, row)
            R = nearest_equivalent(_rotation(modes), expected[row])
            off = np.radians(rotation_angle_deg(matmul(R.T, expected[row])))
            if modes.supported and off < (again if found else 2.0 * again):  # mean shift can wander off to another frame
                if not found:
                    expected = matmul(R, known[row].T, known)
                found.append(Found(R, modes, row))
        kept: list[Found] = []
        for one in sorted(found, key=lambda one: -one.weight):
            if self._is_another(one, kept, directions):
                kept.append(one)
        return kept

    def _search_more(self, directions: Directions, planes: Planes, found: list[Found]) -> list[Found]:
        """Append frames while the directions on no axis lead to another."""
        few = directions.subsample(self.search_samples)
        while len(found) < self.max_frames:
            left = self._left(few, found)
            if found and self._densest(few, left) < self.min_own * few.weights.sum():
                break
            weights = np.where(left, few.weights, SHARED_WEIGHT * few.weights)
            R = search_axes(few.vectors, weights, HALF_SPHERE, np.radians(self.cone_deg), np.radians(self.bandwidth_deg), 4, 2)
            rotations = np.array([*(one.R for one in found), R])
            modes = self._near(directions, planes, rotations, len(found))
            one = Found(_rotation(modes), modes, -1)
            if not modes.supported or not self._is_another(one, found, directions):
                break
            found = [*found, one]
        return found

    def _near(self, directions: Directions, planes: Planes, rotations: F64, row: int) -> Modes:
        """Track the modes of one of the rotations (k, 3, 3), by the directions that belong to it."""
        if len(rotations) == 1:
            return track_modes(self, directions, planes, rotations[row])
        vectors, weights, first = directions
        own = members(vectors, rotations, row, np.radians(self.shared_deg))
        return track_modes(self, Directions(vectors[own], weights[own], int(own[:first].sum())), planes, rotations[row])

    def _is_another(self, one: Found, others: list[Found], directions: Directions) -> bool:
        """Return True if it is none of the others and has enough on axes which are not theirs."""
        if not others:
            return True
        axes = np.concatenate([other.modes.axes[:, other.modes.seen] for other in others], axis=1)
        own = one.modes.seen & (np.abs(matmul(one.modes.axes.T, axes)).max(axis=1) < np.cos(np.radians(self.shared_deg)))
        if one.modes.weights[own].sum() < self.min_own * directions.weights.sum():
            return False
        return bool(symmetric_angles(one.R[None], np.array([other.R for other in others])).min() > np.radians(self.merge_deg))

    def _left(self, directions: Directions, found: list[Found]) -> Bool:
        """Return True (n,) for the directions on no axis that is seen."""
        axes = np.concatenate([np.zeros((3, 0)), *(one.modes.axes[:, one.modes.seen] for one in found)], axis=1)
        return np.asarray((np.abs(matmul(directions.vectors, axes)) < np.cos(np.radians(self.cone_deg))).all(axis=1))

    def _densest(self, directions: Directions, left: Bool) -> float:
        """Return the largest weight of the directions left in any cone."""
        inside = np.abs(matmul(directions.vectors[left], HALF_SPHERE.T)) > np.cos(np.radians(self.cone_deg))
        return float(matmul(directions.weights[left], inside).max())


def members(vectors: F64, rotations: F64, row: int, shared: float) -> Bool:
    """Return True (n,) for each direction (n, 3) that belongs to frame `row` of (k, 3, 3): the nearest of all axes is the frame's, or
    one of the frame's axes is within `shared` (rad) of that axis, as two frames have the floor in common."""
    axes = np.moveaxis(rotations, 2, 1).reshape(-1, 3)
    nearest = np.argmax(np.abs(matmul(vectors, axes.T)), axis=1)
    return np.asarray((np.abs(matmul(rotations[row].T, axes.T)).max(axis=0) > np.cos(shared))[nearest])


def _rotation(modes: Modes) -> F64:
    """Return the rotation (3, 3) nearest to the axes seen."""
    weights = np.where(modes.seen, modes.weights, 1e-6)
    return orthonormal(modes.axes, weights / weights.max())
