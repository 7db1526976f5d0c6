"""Planes by agglomerative hierarchical clustering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from trihedron.pipeline.core.options import PositiveFloat, PositiveShare, Range
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Normals, Planes
from trihedron.plugins.planes.ahc_kernels import cluster_blocks
from trihedron.plugins.planes.blocks_kernels import block_sums, blocks_to_cells
from trihedron.plugins.planes.regions import RegionOptions, complete_planes, grid_of, least_cells
from trihedron.plugins.planes.trimmed_fit_kernels import fit_labelled


@register("planes", "ahc")
@dataclass(frozen=True)
class Ahc(RegionOptions):
    """Agglomerative hierarchical clustering (Feng, Taguchi & Kamat, ICRA 2014) of small blocks by the mean squared error (mse) of their common plane.

    The paper's thresholds (mm², mm) are a noise model of one sensor; here errors are in σ of the frame's own. Its refinement (erode the blocks at the
    border, grow by pixels, cluster once more) is the trimmed fit, growth and merging that all detectors share."""

    block_px: Annotated[int, Range(4, 100)] = 10  # side of a node, Feng et al.
    share: PositiveShare = 0.75  # of a node's cells that must have depth; all of them in the paper, where sensors leave no speckles
    block_sigma: PositiveFloat = 2.0  # rms distance, in σ_z, of a node's depths from its plane
    sigma: PositiveFloat = 1.5  # the same, of a cluster
    shift_sigma: PositiveFloat = 0.8  # rms, in σ_z, by which joining two clusters may move the plane away from the depths of either

    def __call__(self, frame: Frame, normals: Normals) -> Planes:
        """Planes, largest first; `labels` on the grid of the normals, which only help to refine and to tell curved surfaces."""
        grid, stride = grid_of(frame, normals), normals.stride
        side = max(round(self.block_px / stride), 2)
        sums = block_sums(grid, side, self.share)
        blocks, q = cluster_blocks(sums, self.block_sigma**2, self.sigma**2, self.shift_sigma**2, 0.5 * self.min_pixels)
        labels = blocks_to_cells(blocks, side, grid.rho)
        cone = float(np.radians(self.cone_deg))
        core, q = fit_labelled(grid, labels, q, cone, self.gate, least_cells(self, stride))
        return complete_planes(self, core, q, grid, frame, stride, flat=False)
