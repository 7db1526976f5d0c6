"""Cells of a depth image as points for Open3D, and labels back on the grid."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.depth_image_kernels import Grid


def grid_points(grid: Grid) -> tuple[I32, I32, F64]:
    """Rows and columns (n,) of the cells with depth and their points (n, 3) in the camera frame."""
    rows, columns = np.nonzero(grid.rho > 0.0)
    z = 1.0 / grid.rho[rows, columns].astype(np.float64)
    points = np.stack([grid.rays_x[columns] * z, grid.rays_y[rows] * z, z], axis=1)
    return rows.astype(np.int32), columns.astype(np.int32), points


def on_finer_grid(labels: I32, grid: Grid) -> I32:
    """Expand labels of cells of twice the size to a grid (h, w); 0 where it has no depth."""
    h, w = grid.rho.shape
    finer = np.repeat(np.repeat(labels, 2, axis=0), 2, axis=1)[:h, :w]
    return np.ascontiguousarray(finer * (grid.rho > 0.0), np.int32)
