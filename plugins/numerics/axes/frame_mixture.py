"""Several Manhattan frames in one scene: each from the directions that belong to it, more of them from what is left."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trihedron.pipeline.core.geometry import rotation_angle_deg
from trihedron.pipeline.core.types import F64, Bool, Planes
from trihedron.plugins.numerics.axes.axis_fit import HALF_SPHERE
from trihedron.plugins.numerics.axes.cube_symmetry import nearest_equivalent
from trihedron.plugins.numerics.axes.frame_identities import symmetric_angles
from trihedron.plugins.numerics.axes.manhattan_modes import Directions, ModeFinder, Modes
from trihedron.plugins.numerics.axes.sphere_modes import orthonormal, search_axes

SHARED_WEIGHT = 0.2  # what belongs to a known frame may still be an axis of another, but does not lead to one


class Found(NamedTuple):
    """A Manhattan frame seen: its rotation (3, 3), the modes behind it, and which row of the known frames it is (-1: none)."""

    R: F64
    modes: Modes
    row: int

    @property
    def weight(self) -> float:
        """Of the directions on its axes."""
        return float(self.modes.weights[self.modes.seen].sum())


@dataclass(frozen=True)
class FrameMixture:
    """The rules of `mixture.Mixture`, whose fields these are; angles in rad."""

    finder: ModeFinder
    shared: float
    merge: float
    again: float
    min_own: float
    max_frames: int
    search_samples: int

    def followed(self, directions: Directions, planes: Planes, known: F64) -> list[Found]:
        """Those of the known rotations (k, 3, 3) that the scene still supports nearby, heaviest first. The turn of the first one found says where to
        expect those after it."""
        found: list[Found] = []
        expected = known
        for row in range(len(known)):
            modes = self._near(directions, planes, expected, row)
            R = nearest_equivalent(_rotation(modes), expected[row])
            off = np.radians(rotation_angle_deg(R.T @ expected[row]))
            if modes.supported and off < (self.again if found else 2.0 * self.again):  # mean shift can wander off to another frame
                if not found:
                    expected = R @ known[row].T @ known
                found.append(Found(R, modes, row))
        kept: list[Found] = []
        for one in sorted(found, key=lambda one: -one.weight):
            if self._is_another(one, kept, directions):
                kept.append(one)
        return kept

    def searched(self, directions: Directions, planes: Planes, found: list[Found]) -> list[Found]:
        """With those that the directions left over lead to."""
        few = directions.thinned(self.search_samples)
        while len(found) < self.max_frames:
            left = self._left(few, found)
            if found and self._densest(few, left) < self.min_own * few.weights.sum():
                break
            weights = np.where(left, few.weights, SHARED_WEIGHT * few.weights)
            R = search_axes(few.vectors, weights, HALF_SPHERE, self.finder.cone, self.finder.bandwidth, 4, 2)
            rotations = np.array([*(one.R for one in found), R])
            modes = self._near(directions, planes, rotations, len(found))
            one = Found(_rotation(modes), modes, -1)
            if not modes.supported or not self._is_another(one, found, directions):
                break
            found = [*found, one]
        return found

    def _near(self, directions: Directions, planes: Planes, rotations: F64, row: int) -> Modes:
        """Mean shift from one of the rotations (k, 3, 3), with the directions that belong to it."""
        if len(rotations) == 1:
            return self.finder.follow(directions, planes, rotations[row])
        vectors, weights, first = directions
        own = members(vectors, rotations, row, self.shared)
        return self.finder.follow(Directions(vectors[own], weights[own], int(own[:first].sum())), planes, rotations[row])

    def _is_another(self, one: Found, others: list[Found], directions: Directions) -> bool:
        """Whether it is none of the others and has enough on axes which are not theirs."""
        if not others:
            return True
        axes = np.concatenate([other.modes.axes[:, other.modes.seen] for other in others], axis=1)
        own = one.modes.seen & (np.abs(one.modes.axes.T @ axes).max(axis=1) < np.cos(self.shared))
        if one.modes.weights[own].sum() < self.min_own * directions.weights.sum():
            return False
        return bool(symmetric_angles(one.R[None], np.array([other.R for other in others])).min() > self.merge)

    def _left(self, directions: Directions, found: list[Found]) -> Bool:
        """(n,) directions on no axis that is seen."""
        axes = np.concatenate([np.zeros((3, 0)), *(one.modes.axes[:, one.modes.seen] for one in found)], axis=1)
        return np.asarray((np.abs(directions.vectors @ axes) < np.cos(self.finder.cone)).all(axis=1))

    def _densest(self, directions: Directions, left: Bool) -> float:
        """Most weight of the directions left that any cone gathers."""
        inside = np.abs(directions.vectors[left] @ HALF_SPHERE.T) > np.cos(self.finder.cone)
        return float((directions.weights[left] @ inside).max())


def members(vectors: F64, rotations: F64, row: int, shared: float) -> Bool:
    """(n,) whether a direction (n, 3) belongs to one of the frames (k, 3, 3): the nearest of all axes is the frame's, or one of the frame's axes is
    within `shared` (rad) of that axis, as two frames have the floor in common."""
    axes = np.moveaxis(rotations, 2, 1).reshape(-1, 3)
    nearest = np.argmax(np.abs(vectors @ axes.T), axis=1)
    return np.asarray((np.abs(rotations[row].T @ axes.T).max(axis=0) > np.cos(shared))[nearest])


def _rotation(modes: Modes) -> F64:
    """(3, 3) nearest to the axes seen."""
    weights = np.where(modes.seen, modes.weights, 1e-6)
    return orthonormal(modes.axes, weights / weights.max())
