"""What is reported of planes beside their labels: coefficients, how these depend on q, how much worse than their noise they are known, samples."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.types import F32, F64, U8
from trihedron.plugins.numerics.algebra.small_linear import fill_tangent_basis
from trihedron.plugins.numerics.depth.organised_grid import Grid
from trihedron.plugins.numerics.planes.plane_regions import excess_variance, spread_samples


@numba.njit(cache=True, nogil=True, error_model="numpy")
def plane_report(
    labels: U8, core: U8, planes: F64, grid: Grid, tiles: int, expected: float, weight: float, wanted: int, most: int
) -> tuple[F64, F64, F64, F32]:
    """Of planes q (k, 3) with their regions' labels and cores (h, w): the coefficients (k, 4), the derivative (k, 3, 3) of (a, b, d) by q, the
    variance (k,) as by `excess_variance` and the samples (k, wanted, 3) as by `spread_samples`."""
    coefficients, J = np.empty((len(planes), 4)), np.empty((len(planes), 3, 3))
    for k in range(len(planes)):
        x, y, z = planes[k, 0], planes[k, 1], planes[k, 2]
        d = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-12)
        coefficients[k, 0], coefficients[k, 1], coefficients[k, 2], coefficients[k, 3] = -x * d, -y * d, -z * d, d
        fill_tangent_basis(coefficients[k], J[k])
        for i in range(3):
            J[k, 0, i], J[k, 1, i], J[k, 2, i] = -d * J[k, 0, i], -d * J[k, 1, i], d * d * coefficients[k, i]
    variance = excess_variance(core, planes, grid, tiles, expected, weight)
    return coefficients, J, variance, spread_samples(labels, planes, grid.rays_x, grid.rays_y, wanted, most)
