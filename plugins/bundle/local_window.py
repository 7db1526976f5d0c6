"""Bundle adjustment of the newest keyframes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from trihedron.pipeline.core.options import NonNegativeInt, PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Correction, Map
from trihedron.plugins.bundle.common import bundle_correction, bundle_problem, bundle_window, solve_bundle
from trihedron.plugins.mapping.covisibility_graph import newest_keyframes


@register("bundle", "local_window")
@dataclass(frozen=True)
class LocalWindow:
    """Once a keyframe: the newest ones, their points, lines and planes, and the right angles between these, at once.

    Levenberg–Marquardt with the Schur complement on what the keyframes measured, each weighed by its covariance, with Huber's cost. Keyframes outside
    the window that see its landmarks are held, and so is the first of all, which is the world."""

    keyframes: PositiveInt = 8  # at most, that may move: the newest and those that share most landmarks with it
    fixed: NonNegativeInt = 8  # at most, that are held
    iterations: PositiveInt = 10
    line_sigma_px: PositiveFloat = 1.0  # of a segment's end point across it, as in the map
    relation_sigma_deg: PositiveFloat = 0.5  # walls are parallel or perpendicular to within this
    parallel_deg: Annotated[float, Range(above=0, below=45)] = 5.0  # planes nearer to parallel, or to a right angle, are meant to be

    def __call__(self, map: Map) -> Correction | None:
        """The correction, or None when this version of the map has no new keyframe, or nothing that could move."""
        newest = newest_keyframes(map, 1)
        if not len(newest) or map.keyframes.rows("index", newest)[0] != map.index:
            return None
        window = bundle_window(map, self.keyframes, self.fixed)
        if not len(window.free):
            return None
        problem = bundle_problem(map, window, self.line_sigma_px, self.relation_sigma_deg, self.parallel_deg)
        return bundle_correction(map, window, solve_bundle(*problem, self.iterations))
