"""Planes grown over coarse cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import AcuteDeg, PositiveFloat, PositiveInt, PositiveShare, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals, Planes
from trihedron.plugins.planes.blocks_kernels import block_planes, block_sums, blocks_to_cells
from trihedron.plugins.planes.cape_kernels import grow_blocks
from trihedron.plugins.planes.regions import RegionOptions, complete_planes, grid_of, least_cells
from trihedron.plugins.planes.trimmed_fit_kernels import fit_labelled


@register("planes", "cape")
@dataclass(frozen=True)
class Cape(RegionOptions):
    """Cell-wise plane extraction (Proença & Gao, IROS 2018): the fastest, and blind to planes narrower than two cells.

    Planarity is the mean squared error of a cell's least-squares plane in σ of the frame's noise model; the paper takes the least eigenvalue of its
    points' covariance, and a constant. Its refinement by pixels is the trimmed fit and growth that all detectors share; no cylinders."""

    block_px: Annotated[int, Range(4, 100)] = 20  # side of a cell, Proença & Gao
    share: PositiveShare = 0.5  # of its pixels that must have depth, Proença & Gao
    sigma: PositiveFloat = 1.5  # rms distance, in σ_z, of a planar cell's depths from its plane, and from its region's
    step_sigma: PositiveFloat = 4.0  # the same, from the plane of the neighbour it is reached from
    angle_deg: AcuteDeg = 15.0  # between the normals of neighbours in a region, Proença & Gao
    least: PositiveInt = 3  # cells of a region; 5 in the paper, which wants no small planes

    def __call__(self, frame: Frame, normals: Normals) -> Planes:
        """Planes, largest first; `labels` on the grid of the normals, which only help to refine and to tell curved surfaces."""
        grid, stride = grid_of(frame, normals), normals.stride
        side = max(round(self.block_px / stride), 2)
        sums = block_sums(grid, side, self.share)
        flat = block_planes(sums)
        cos_angle = float(np.cos(np.radians(self.angle_deg)))
        blocks, q = grow_blocks(sums, *flat, self.sigma**2, cos_angle, self.step_sigma**2, self.least)
        labels = blocks_to_cells(blocks, side, grid.rho)
        cone = float(np.radians(self.cone_deg))
        core, q = fit_labelled(grid, labels, q, cone, self.gate, least_cells(self, stride))
        return complete_planes(self, core, q, grid, frame, stride, flat=False)
