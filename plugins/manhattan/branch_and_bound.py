"""The Manhattan frame by branch and bound: the best of all rotations, with a proof."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.numerics.axes.cube_symmetry import nearest_equivalent
from trihedron.plugins.numerics.axes.manhattan_modes import Directions
from trihedron.plugins.numerics.axes.mode_options import ModeOptions
from trihedron.plugins.numerics.axes.rotation_search import RotationSearch


@register("manhattan", "branch_and_bound")
@dataclass(frozen=True)
class BranchAndBound(ModeOptions):
    """The rotation with the greatest consensus of normals, planes and lines, found among all rotations whatever the previous frame was (Bazin et al.,
    ACCV 2012; Joo et al., CVPR 2016; consensus and bounds in `axes.consensus`, the search in `axes.rotation_search`).

    What is certified, for the directions that take part in the search (`search_samples` normals spread over the image, all planes and lines): `gap`
    is how much more consensus, as a share, any rotation could have than the one returned; and unless the work limit was met, none further than
    `certificate_deg` from the optimum, by whichever of its 24 names, has more than 1 + `max_gap` times its consensus. Work is limited in cubes, not
    in time, because the result must not depend on the machine's speed or load; a core does 500 to 900 in a millisecond, and most scenes with a
    Manhattan frame need 1000 to 4000. The optimum then says where the modes are: from there on rotation, covariance and the judgement whether this is
    a Manhattan frame are those of `mean_shift`."""

    inlier_deg: float = 12.0  # furthest from an axis that a direction counts; at least three times the normals' noise
    certificate_deg: float = 1.0  # rotations nearer to the optimum than this need not be told from it
    max_gap: float = 0.001  # by which share a rotation further off must be better to be looked for
    max_cubes: int = 10000  # of rotations looked at
    search_samples: int = 1500  # most normals searched with
    plane_weight: float = 0.5  # of a plane, in normals on its region

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 2.0 <= self.inlier_deg <= 20.0 or not 0.1 <= self.certificate_deg < self.inlier_deg:
            raise ValueError("inlier_deg, certificate_deg: inlier_deg must be 2 to 20 and certificate_deg 0.1 to less than inlier_deg")
        if self.max_gap < 0.0 or self.max_cubes < 1 or self.search_samples < 10 or self.plane_weight < 0.0:
            raise ValueError("max_gap, max_cubes, search_samples, plane_weight: at least 0, 1, 10 and 0")

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """One rotation with id 0 and its `gap`; `supported` False, with a large covariance and no gap (NaN), where the scene shows no two axes at
        right angles. Only its naming, and the angles that the scene does not tell, are those of `previous`."""
        directions = self.directions(normals, segments)
        vectors, weights = self._with_planes(directions.thinned(self.search_samples), planes)
        start = np.eye(3) if previous is None else previous.rotations[0]
        optimum = self._search(vectors, weights, start)
        modes = self.finder.follow(directions, planes, nearest_equivalent(optimum.R, start))
        if not modes.supported and previous is not None:
            modes = self.finder.follow(directions, planes, start)
        R, covariance = self.fitted(modes, segments, planes)
        reached = self._search.consensus(vectors, weights, R) if modes.supported else 0.0
        return self.frame(modes, R, covariance, normals, float(optimum.upper / reached - 1.0) if reached > 0.0 else float("nan"))

    def _with_planes(self, directions: Directions, planes: Planes) -> tuple[F64, F64]:
        """The directions and the planes' normals (n, 3), and the weights (n,)."""
        surface = directions.weights[: directions.first_line].sum() or self.samples  # without normals planes weigh as if there were some
        per_pixel = self.plane_weight * self.use_planes * surface / max(planes.labels.size * planes.stride**2, 1)
        vectors = np.concatenate([directions.vectors, planes.coefficients[:, :3]])
        return vectors, np.concatenate([directions.weights, per_pixel * planes.pixels])

    @cached_property
    def _search(self) -> RotationSearch:
        return RotationSearch(np.radians(self.inlier_deg), np.radians(self.certificate_deg), self.max_gap, self.max_cubes)
