"""The Manhattan frame by mean shift on the unit sphere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.registry import register
from trihedron.pipeline.types import ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.numerics.axes.axis_fit import HALF_SPHERE
from trihedron.plugins.numerics.axes.cube_symmetry import nearest_equivalent
from trihedron.plugins.numerics.axes.manhattan_modes import Directions, Modes
from trihedron.plugins.numerics.axes.mode_options import ModeOptions
from trihedron.plugins.numerics.axes.sphere_modes import search_axes


@register("manhattan", "mean_shift")
@dataclass(frozen=True)
class MeanShift(ModeOptions):
    """Follow the three density modes of normals and line directions from the previous frame's axes (paper, section IV-A; Zhou et al., ACCV 2016).

    The modes say which directions belong to which axis and whether there is a Manhattan frame at all; the rotation is then fitted to the planes and
    lines on the axes by their covariances, the mean of the normals on an axis counting like one more plane."""

    max_age: int = 10  # frames after which the previous axes are old
    search_samples: int = 400  # most normals a search looks at
    primaries: int = 6  # directions a search starts from
    turns: int = 2  # and turns about each

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.primaries, self.turns, self.max_age) < 1 or self.search_samples < 10:
            raise ValueError("primaries, turns, max_age, search_samples: at least 1; search_samples at least 10")

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """One rotation with id 0; `supported` False, with a large covariance, where the scene shows no two axes at right angles."""
        modes = self._modes(self.directions(normals, segments), planes, previous, normals.index)
        return self.frame(modes, *self.fitted(modes, segments, planes), normals)

    def _modes(self, directions: Directions, planes: Planes, previous: ManhattanFrame | None, index: int) -> Modes:
        """Near the previous axes; from everywhere when there are none, they are old or nothing supports them."""
        finder, start = self.finder, np.eye(3) if previous is None else np.array(previous.rotations[0])
        near = finder.follow(directions, planes, start) if previous is not None else None
        if previous is not None and near is not None and previous.supported and near.supported and index - previous.index <= self.max_age:
            return near
        few = directions.thinned(self.search_samples)
        found = search_axes(few.vectors, few.weights, HALF_SPHERE, finder.cone, finder.bandwidth, self.primaries, self.turns)
        far = finder.follow(directions, planes, nearest_equivalent(found, start))
        return far if far.supported or near is None else near
