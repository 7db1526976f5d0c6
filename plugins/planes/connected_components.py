"""Planes as connected components of the organised normals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from trihedron.pipeline.core.options import AcuteDeg, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals, Planes
from trihedron.plugins.planes.connected_components_kernels import planar_components
from trihedron.plugins.planes.regions import EDGE, EDGE_M, RegionOptions, complete_planes, grid_of, least_cells
from trihedron.plugins.planes.trimmed_fit_kernels import MAX_REGIONS


@register("planes", "connected_components")
@dataclass(frozen=True)
class ConnectedComponents(RegionOptions):
    """Connected components (Trevor et al., SPME 2013; paper, section III-A), each checked to be one plane, grown to its border, merged and fitted by
    weighted least squares in inverse depth."""

    angle_deg: AcuteDeg = 3.0  # normals of neighbouring cells of one component differ by less (Trevor et al.)
    rounds: Annotated[int, Range(1, 6)] = 3  # components are sought among what is left, this often, with half the cone in each further round

    def __call__(self, frame: Frame, normals: Normals) -> Planes:
        """Planes, largest first; `labels` on the grid of the normals."""
        grid, cone = grid_of(frame, normals), math.radians(self.cone_deg)
        angle = 2.0 * math.radians(self.angle_deg)  # between cells of twice the size
        least = least_cells(self, 2 * normals.stride)
        core, q = planar_components(grid, (EDGE, EDGE_M), angle, self.gate, cone, self.turn, self.rounds, least, MAX_REGIONS)
        return complete_planes(self, core, q, grid, frame, normals.stride)
