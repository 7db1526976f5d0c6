"""Loop closing by the layout of planes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Correction, Frame, Map
from trihedron.plugins.loop.loop_closing import LoopOptions, close_loop, drift_sigma_m, within_reach
from trihedron.plugins.loop.plane_layout import displacement_of_planes
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.mapping.landmark_kinds import PLANE


@register("loop", "planes")
@dataclass(frozen=True)
class PlanesLoop(LoopOptions):
    """Recognise a place by its planes: normals, offsets and extents that agree on one displacement within the expected drift.

    Every candidate is verified with points, lines and planes and by free space; the correction is that of a pose graph."""

    looked_at: PositiveInt = 20  # keyframes within reach whose layout is compared, the nearest first
    min_layout: NonNegativeFloat = 0.3  # planes whose extents agree, at least

    def __call__(self, map: Map, frame: Frame) -> Correction | None:
        """Return the correction; None unless the newest keyframe closes a loop, or the map has rotated out of its Manhattan frame."""
        return close_loop(self, self._rank, map, frame)

    def _rank(self, map: Map) -> Iterator[tuple[int, float]]:
        """Keyframes within reach, best layout first, with the length of the path since."""
        rows, path_m = within_reach(self, map, self.looked_at)
        here = observed_by(map, np.array([len(map.keyframes) - 1], np.int32), PLANE)
        places = [observed_by(map, rows[k : k + 1], PLANE) for k in range(len(rows))]
        scores = np.array([displacement_of_planes(map, here, there, float(drift_sigma_m(self, path_m[k])))[1] for k, there in enumerate(places)])
        for k in np.argsort(-scores, kind="stable"):
            if scores[k] >= self.min_layout:
                yield int(rows[k]), float(path_m[k])
