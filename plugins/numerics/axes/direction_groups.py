"""Directions on the sphere, antipodes being one, sorted into groups of neighbours with their moments."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.numerics.axes.sphere_grid import cell_of

CELLS = 64  # a face of the sphere's grid: groups reach 1.3° from their mean at most


class Groups(NamedTuple):
    """n directions in m groups, group g being rows `first[g]` to `first[g + 1]`."""

    vectors: F64  # (n, 3) unit
    weights: F64  # (n,)
    first: I32  # (m + 1,)
    means: F64  # (m, 5) unit mean, cosine and sine of the largest angle to it
    moments: F64  # (m, 7) Σ w d dᵀ (xx, xy, xz, yy, yz, zz) and Σ w
    total: float  # of the weights


@numba.njit(cache=True, nogil=True, error_model="numpy")
def group_directions(vectors: F64, weights: F64) -> Groups:
    """Group unit directions (n, 3) with positive weights (n,) by cells of the sphere; d and -d are the same."""
    n = CELLS
    cells = np.empty(len(vectors), np.int64)
    row, groups, total = np.zeros(3 * n * n + 1, np.int64), 0, 0.0
    for i in range(len(vectors)):
        cells[i] = cell_of(vectors[i, 0], vectors[i, 1], vectors[i, 2], n)
        groups += row[cells[i] + 1] == 0
        row[cells[i] + 1] += 1
        total += weights[i]
    first = np.zeros(groups + 1, np.int32)
    g = 0
    for c in range(3 * n * n):
        if row[c + 1] > 0:
            g += 1
            first[g] = row[c] + row[c + 1]
        row[c + 1] += row[c]
    in_order, in_order_weights = np.empty_like(vectors), np.empty_like(weights)
    for i in range(len(vectors)):
        sign = 1.0 if vectors[i, cells[i] // (n * n)] > 0.0 else -1.0
        r = row[cells[i]]
        row[cells[i]] += 1
        in_order_weights[r] = weights[i]
        for k in range(3):
            in_order[r, k] = sign * vectors[i, k]
    means, moments = np.zeros((groups, 5)), np.zeros((groups, 7))
    for g in range(groups):
        _summarise(in_order, in_order_weights, first[g], first[g + 1], means[g], moments[g])
    return Groups(in_order, in_order_weights, first, means, moments, total)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _summarise(vectors: F64, weights: F64, begin: int, end: int, mean: F64, moments: F64) -> None:
    """Fill a row of `Groups.means` and of `Groups.moments`."""
    for i in range(begin, end):
        add_moments(moments, weights[i], vectors[i, 0], vectors[i, 1], vectors[i, 2])
        for k in range(3):
            mean[k] += weights[i] * vectors[i, k]
    norm = np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
    for k in range(3):
        mean[k] /= norm
    mean[3] = 1.0
    for i in range(begin, end):
        mean[3] = min(mean[3], vectors[i, 0] * mean[0] + vectors[i, 1] * mean[1] + vectors[i, 2] * mean[2])
    mean[4] = np.sqrt(max(1.0 - mean[3] ** 2, 0.0))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_moments(moments: F64, w: float, x: float, y: float, z: float) -> None:
    """Add a direction to a row of `Groups.moments`."""
    moments[0] += w * x * x
    moments[1] += w * x * y
    moments[2] += w * x * z
    moments[3] += w * y * y
    moments[4] += w * y * z
    moments[5] += w * z * z
    moments[6] += w
