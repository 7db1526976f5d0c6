"""Planes by sequential RANSAC."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveInt, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals, Planes
from trihedron.plugins.planes.ransac_kernels import consensus_planes
from trihedron.plugins.planes.regions import EDGE, EDGE_M, RegionOptions, complete_planes, grid_of, least_cells
from trihedron.plugins.planes.trimmed_fit_kernels import MAX_REGIONS, fit_labelled
from trihedron.plugins.shared.depth_image_kernels import coarser


@register("planes", "ransac")
@dataclass(frozen=True)
class Ransac(RegionOptions):
    """Sequential RANSAC (Fischler & Bolles 1981, scored as MSAC, Torr & Zisserman 2000): the plane with the best consensus, its largest connected
    region, then the next among what is left; on cells of twice the size. It needs no smooth neighbourhoods, and its random numbers are `rng`'s."""

    hypotheses: Annotated[int, Range(1, 10000)] = 120  # planes drawn for each one found
    rounds: Annotated[int, Range(1, MAX_REGIONS)] = 40  # at most
    misses: PositiveInt = 5  # rounds in a row without a region, before the search ends
    sigma: PositiveFloat = 2.0  # σ_z of an inlier's depth

    def __call__(self, frame: Frame, normals: Normals, rng: np.random.Generator) -> Planes:
        """Planes, largest first; `labels` on the grid of the normals, which are asked where there are any."""
        grid, stride = grid_of(frame, normals), normals.stride
        cone = float(np.radians(self.cone_deg))
        draws = rng.random((self.rounds, self.hypotheses, 7))
        coarse = coarser(grid, EDGE, EDGE_M)
        found, q = consensus_planes(coarse, draws, self.sigma, float(np.cos(cone)), least_cells(self, 2 * stride), self.misses)
        labels = np.repeat(np.repeat(found, 2, axis=0), 2, axis=1)[: grid.rho.shape[0], : grid.rho.shape[1]] * (grid.rho > 0.0)
        core, q = fit_labelled(grid, labels, q, cone, self.gate, least_cells(self, stride))
        return complete_planes(self, core, q, grid, frame, stride, flat=False)
