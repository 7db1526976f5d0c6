"""Planes as connected components of the organised normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trihedron.pipeline.registry import register
from trihedron.pipeline.types import F64, I32, Bool, Frame, Normals, Planes
from trihedron.plugins.numerics.depth.organised_grid import Grid, cells_by_component, coarser, connected_components, smooth_links
from trihedron.plugins.numerics.planes.planar_regions import EDGE, EDGE_M, MOST, PlanarRegions
from trihedron.plugins.numerics.planes.plane_fitting import fit_components


@register("planes", "connected_components")
@dataclass(frozen=True)
class ConnectedComponents(PlanarRegions):
    """Connected components (Trevor et al., SPME 2013; paper, section III-A), each checked to be one plane, grown to its border, merged and fitted by
    weighted least squares in inverse depth."""

    angle_deg: float = 3.0  # normals of neighbouring cells of one component differ by less (Trevor et al.)
    rounds: int = 3  # components are sought among what is left, this often, with half the cone in each further round

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 < self.angle_deg < 90.0 or not 1 <= self.rounds <= 6:
            raise ValueError("angle_deg, rounds: must be above 0 and below 90, and 1 to 6")

    def __call__(self, frame: Frame, normals: Normals) -> Planes:
        """Planes, largest first; `labels` on the grid of the normals."""
        grid = self._grid(frame, normals)
        found, q = self._find(coarser(grid, EDGE, EDGE_M), 2 * normals.stride)
        core = np.repeat(np.repeat(found, 2, axis=0), 2, axis=1)[: grid.rho.shape[0], : grid.rho.shape[1]] * (grid.rho > 0.0)
        return self._complete(core, q, grid, frame, normals.stride)

    def _find(self, grid: Grid, stride: int) -> tuple[I32, F64]:
        """Labels (h, w) of the cells that make up each plane, and the planes' q (k, 3), on cells of twice the size: a quarter of the work."""
        labels, planes, found = np.zeros(grid.rho.shape, np.int32), np.zeros((MOST, 3)), 0
        least = self._least(stride)
        links = smooth_links(grid, float(np.cos(2.0 * np.radians(self.angle_deg))), self.gate)  # the same bend per metre
        usable: Bool = (grid.rho > 0.0) & ~np.isnan(grid.normals[..., 0])
        for turn in range(self.rounds):
            cone = float(np.radians(self.cone_deg)) / 2**turn
            cells, starts = cells_by_component(connected_components(links, usable & (labels == 0)), least)
            found = fit_components(grid, cells, starts, cone, self.gate, self.turn * cone, least, labels, planes, found)
        return labels, planes[:found]
