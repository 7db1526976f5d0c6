"""The Manhattan frame by branch and bound: the best of all rotations, with a proof."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np

from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.options import NonNegativeFloat, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import F64, ManhattanFrame, Normals, Planes, Segments
from trihedron.plugins.manhattan.branch_and_bound_kernels import (
    CELLS,
    FIRST,
    HALF_WIDTH,
    Maps,
    Neighbours,
    SphereGrid,
    coarser,
    cube_radius,
    group_directions,
    image,
    largest_near,
    neighbours,
    search,
)
from trihedron.plugins.manhattan.directions import Directions
from trihedron.plugins.manhattan.modes import ModeOptions, directions_of, fit_modes, one_frame, track_modes
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent


@register("manhattan", "branch_and_bound")
@dataclass(frozen=True)
class BranchAndBound(ModeOptions):
    """The rotation with the greatest consensus of normals, planes and lines, found among all rotations whatever the previous frame was (Bazin et al.,
    ACCV 2012; Joo et al., CVPR 2016).

    What is certified, for the directions that take part in the search (`search_samples` normals spread over the image, all planes and lines): `gap`
    is how much more consensus, as a share, any rotation could have than the one returned; and unless the work limit was met, none further than
    `certificate_deg` from the optimum, by whichever of its 24 names, has more than 1 + `max_gap` times its consensus. Work is limited in cubes, not
    in time, because the result must not depend on the machine's speed or load; a core does 500 to 900 in a millisecond, and most scenes with a
    Manhattan frame need 1000 to 4000. The optimum then gives the modes: from there on rotation, covariance and the judgement whether this is
    a Manhattan frame are those of `mean_shift`."""

    inlier_deg: Annotated[float, Range(2, 20)] = 12.0  # furthest from an axis that a direction counts; at least three times the normals' noise
    certificate_deg: Annotated[float, Range(0.1)] = 1.0  # rotations nearer to the optimum than this need not be distinguished from it
    max_gap: NonNegativeFloat = 0.001  # by which share a rotation further off must be better to be looked for
    max_cubes: PositiveInt = 10000  # of rotations looked at
    search_samples: Annotated[int, Range(10)] = 1500  # most normals searched with
    plane_weight: NonNegativeFloat = 0.5  # of a plane, in normals on its region

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.certificate_deg < self.inlier_deg:
            raise ValueError(f"certificate_deg: {self.certificate_deg} is not below inlier_deg, {self.inlier_deg}")

    def __call__(self, normals: Normals, segments: Segments, planes: Planes, previous: ManhattanFrame | None) -> ManhattanFrame:
        """One rotation with id 0 and its `gap`; `supported` False, with a large covariance and no gap (NaN), where the scene shows no two axes at
        right angles. Only its naming, and the angles that the scene does not tell, are those of `previous`."""
        directions = directions_of(self, normals, segments)
        vectors, weights = self._with_planes(directions.subsample(self.search_samples), planes)
        start = np.eye(3) if previous is None else previous.rotations[0]
        optimum = self._search(vectors, weights, start)
        modes = track_modes(self, directions, planes, nearest_equivalent(optimum.R, start))
        if not modes.supported and previous is not None:
            modes = track_modes(self, directions, planes, start)
        R, covariance = fit_modes(self, modes, segments, planes)
        reached = self._search.consensus(vectors, weights, R) if modes.supported else 0.0
        return one_frame(modes, R, covariance, normals, float(optimum.upper / reached - 1.0) if reached > 0.0 else float("nan"))

    def _with_planes(self, directions: Directions, planes: Planes) -> tuple[F64, F64]:
        """The directions and the planes' normals (n, 3), and the weights (n,)."""
        surface = directions.weights[: directions.first_line].sum() or self.samples  # without normals planes weigh as if there were some
        per_pixel = self.plane_weight * self.use_planes * surface / max(planes.labels.size * planes.stride**2, 1)
        vectors = np.concatenate([directions.vectors, planes.coefficients[:, :3]])
        return vectors, np.concatenate([directions.weights, per_pixel * planes.pixels])

    @cached_property
    def _search(self) -> RotationSearch:
        return RotationSearch(self)


FACE = (12, 24, 48)  # cells a face of the maps for the first levels, whose cubes are 9.7°, 4.9° and 2.4° in radius


class Optimum(NamedTuple):
    """Result of a search and its certified bound."""

    R: F64  # (3, 3)
    consensus: float
    upper: float  # no rotation has more
    cubes: int  # looked at
    open: int  # left undecided at the work limit: 0 when nothing further than the certificate from R is better


@dataclass(frozen=True)
class RotationSearch:
    """Best rotation for weighted directions, from anywhere, with a proof.

    The rotations are covered by cubes of rotation vectors `v` in `R_start Exp(v)`, of half side σ; every rotation of a cube is within √3 σ of its
    centre (Hartley and Kahl). Level by level a cube is dropped when even its upper bound is not above the best consensus found, else split in eight.
    The first bounds are three look-ups in maps on the sphere, the later ones sums over all directions (`consensus_bound`)."""

    options: BranchAndBound

    def __call__(self, vectors: F64, weights: F64, start: F64) -> Optimum:
        """The optimum for directions (n, 3) of any length but 0 and weights (n,); rows that are not finite or weigh nothing are left out. `start`
        (3, 3) is the first guess and the middle of the search; the result is certified whatever it is."""
        unit, weights = _usable(vectors, weights)
        if len(unit) == 0:
            return Optimum(start, 0.0, 0.0, 0, 0)
        groups = group_directions(unit, weights)
        cells = image(groups, self._grid, self._cones, self._inlier)
        middle = coarser(cells, FACE[2])
        near = [largest_near(values, reach) for values, reach in zip((coarser(middle, FACE[1]), middle, cells), self._reaches)]
        maps = Maps(cells, (near[0], near[1], near[2]))
        certificate, options = np.radians(self.options.certificate_deg), self.options
        found = search(groups, maps, start, self._inlier, certificate, options.max_gap, options.max_cubes)
        return Optimum(*found)

    def consensus(self, vectors: F64, weights: F64, R: F64) -> float:
        """C(R) of the same directions."""
        unit, weights = _usable(vectors, weights)
        square = np.max(matmul(unit, R) ** 2, axis=1, initial=0.0)
        return float(float(matmul(weights, np.maximum(square - np.cos(self._inlier) ** 2, 0.0))) / np.sin(self._inlier) ** 2)

    @property
    def _inlier(self) -> float:
        """τ of the consensus, rad."""
        return float(np.radians(self.options.inlier_deg))

    @cached_property
    def _grid(self) -> SphereGrid:
        return sphere_grid(FACE[2])

    @cached_property
    def _cones(self) -> Neighbours:
        """Cells within τ of a direction whose group's mean is in the cell."""
        return neighbours(self._grid, self._inlier + 2.0 * float(sphere_grid(CELLS).radii.max()))

    @cached_property
    def _reaches(self) -> list[Neighbours]:
        """For each level the cells within the radius of its cubes of each."""
        return [neighbours(sphere_grid(face), cube_radius(HALF_WIDTH / FIRST / 2**level)) for level, face in enumerate(FACE)]


def _usable(vectors: F64, weights: F64) -> tuple[F64, F64]:
    """The finite directions, made unit, with positive weights."""
    length = np.linalg.norm(vectors, axis=1)
    good = np.isfinite(length) & (length > 1e-6) & np.isfinite(weights) & (weights > 0.0)
    return vectors[good] / length[good, None], weights[good]


def sphere_grid(n: int) -> SphereGrid:
    """The grid with n by n cells a face."""
    edges = np.linspace(-1.0, 1.0, n + 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    centres = _on_faces(middles, middles)
    # a cell is a convex quadrangle, so its corners are furthest from any of its points
    corners = [_on_faces(u, v) for u in (edges[:-1], edges[1:]) for v in (edges[:-1], edges[1:])]
    radii = [np.arccos(np.clip((centres * corner).sum(axis=1), -1.0, 1.0)) for corner in corners]
    return SphereGrid(centres, np.max(radii, axis=0))


def _on_faces(u: F64, v: F64) -> F64:
    """(3 · len(u) · len(v), 3) unit directions at every (u, v) of the three faces."""
    out = np.empty((3, len(u), len(v), 3))
    for face in range(3):
        out[face, :, :, face] = 1.0
        out[face, :, :, (face + 1) % 3] = u[:, None]
        out[face, :, :, (face + 2) % 3] = v
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    return out.reshape(-1, 3)
