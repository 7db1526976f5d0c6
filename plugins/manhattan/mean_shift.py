"""The Manhattan frame by mean shift on the unit sphere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.manhattan.directions import HALF_SPHERE, Directions
from trihedron.plugins.manhattan.mean_shift_kernels import search_axes
from trihedron.plugins.manhattan.modes import ModeOptions, Modes, directions_of, fit_modes, one_frame, shift_limits, track_modes
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent


@register("manhattan", "mean_shift")
@dataclass(frozen=True)
class MeanShift(ModeOptions):
    """Follow the three density modes of normals and line directions from the previous frame's axes (paper, section IV-A; Zhou et al., ACCV 2016).

    The modes say which directions belong to which axis and whether there is a Manhattan frame at all; the rotation is then fitted to the planes and
    lines on the axes by their covariances, the mean of the normals on an axis counting like one more plane."""

    max_age: PositiveInt = 10  # frames after which the previous axes are old
    search_samples: Annotated[int, Range(10)] = 400  # most normals a search looks at
    primaries: PositiveInt = 6  # directions a search starts from
    turns: PositiveInt = 2  # and turns about each

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """One rotation with id 0; `supported` False, with a large covariance, where the scene shows no two axes at right angles."""
        modes = self._modes(directions_of(self, normals, segments), planes, previous, normals.index)
        return one_frame(modes, *fit_modes(self, modes, segments, planes), normals)

    def _modes(self, directions: Directions, planes: Planes, previous: ManhattanFrame | None, index: int) -> Modes:
        """Find the modes near the previous axes; from everywhere when there are none, they are old or nothing supports them."""
        if previous is None:
            return self._anywhere(directions, planes, np.eye(3))
        start = np.array(previous.rotations[0])
        near = track_modes(self, directions, planes, start)
        if previous.supported and near.supported and index - previous.index <= self.max_age:
            return near
        far = self._anywhere(directions, planes, start)
        return far if far.supported else near

    def _anywhere(self, directions: Directions, planes: Planes, names: F64) -> Modes:
        """Find the densest axes of all, in the order and with the signs nearest to those of `names` (3, 3)."""
        few, shift = directions.subsample(self.search_samples), shift_limits(self)
        found = search_axes(few.vectors, few.weights, HALF_SPHERE, shift.cone, shift.bandwidth, self.primaries, self.turns)
        return track_modes(self, directions, planes, nearest_equivalent(found, names))
