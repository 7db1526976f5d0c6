"""Loops found by the layout of planes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.core.options import NonNegativeFloat, PositiveInt
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Map
from trihedron.plugins.loop.common import LoopClosing, shift_of_planes, within_reach
from trihedron.plugins.mapping.covisibility_graph import observed_by


@register("loop", "planes")
@dataclass(frozen=True)
class PlanesLoop(LoopClosing):
    """Recognise a place by its planes: directions, offsets and extents that agree on one displacement within the drift to be expected.

    Every candidate is verified with points, lines and planes and by free space; the correction is that of a pose graph."""

    looked_at: PositiveInt = 20  # keyframes within reach whose layout is compared, the nearest first
    min_layout: NonNegativeFloat = 0.3  # planes whose extents agree, at least

    def ranked(self, map: Map) -> Iterator[tuple[int, float]]:
        """Keyframes within reach, best layout first, with the way walked since."""
        rows, way = within_reach(map, self.reach)
        rows, way = rows[: self.looked_at], way[: self.looked_at]
        here = observed_by(map, np.array([len(map.keyframes) - 1], np.int32), "plane")
        scores = np.array(
            [shift_of_planes(map, here, observed_by(map, rows[k : k + 1], "plane"), float(self.reach.sigma_m(way[k])))[1] for k in range(len(rows))]
        )
        for k in np.argsort(-scores, kind="stable"):
            if scores[k] >= self.min_layout:
                yield int(rows[k]), float(way[k])
