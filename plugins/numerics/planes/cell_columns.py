"""What least squares ask of a region's cells, gathered once: columns side by side, of which the compiler takes several numbers at once."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.numerics.depth.organised_grid import Grid

SOME = 2000  # cells that show where most of a region is


@numba.njit(cache=True, nogil=True, error_model="numpy")
def columns_of(grid: Grid, cells: I32) -> F64:
    """(8, n) of the cells, whose numbers ascend: x/z and y/z, inverse depth, its σ, its weight `count / σ²`, and the normal."""
    rho, sigma, count, normals = grid.rho.ravel(), grid.sigma.ravel(), grid.count.ravel(), grid.normals.reshape(-1, 3)
    out, w = np.empty((8, len(cells))), len(grid.rays_x)
    r = 0
    for k in range(len(cells)):
        i = cells[k]
        while i >= (r + 1) * w:
            r += 1
        out[0, k], out[1, k], out[2, k], out[3, k] = grid.rays_x[i - r * w], grid.rays_y[r], rho[i], sigma[i]
        out[4, k], out[5, k], out[6, k], out[7, k] = np.int32(count[i]) / (sigma[i] * sigma[i]), normals[i, 0], normals[i, 1], normals[i, 2]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def thinned(columns: F64) -> F64:
    """One cell in as many as leave at least SOME."""
    step = max(columns.shape[1] // SOME, 1)
    if step == 1:
        return columns
    out = np.empty((8, (columns.shape[1] + step - 1) // step))
    for j in range(8):
        for k in range(out.shape[1]):
            out[j, k] = columns[j, k * step]
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def thinned_marks(marks: Bool) -> Bool:
    """The marks (n,) of the cells that `thinned` leaves."""
    return marks[:: max(len(marks) // SOME, 1)].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(columns: F64, chosen: Bool) -> tuple[F64, F64]:
    """Of q, from the weighted depths of the chosen cells: A (3, 3), of which only the upper triangle is filled, and b (3,)."""
    xs, ys, rho, weights = columns[0], columns[1], columns[2], columns[4]
    xx, xy, x1, yy, y1, one, xp, yp, p1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(chosen)):
        x, y, p, weight = xs[k], ys[k], rho[k], weights[k] if chosen[k] else 0.0
        xx, xy, x1 = xx + weight * x * x, xy + weight * x * y, x1 + weight * x
        yy, y1, one = yy + weight * y * y, y1 + weight * y, one + weight
        xp, yp, p1 = xp + weight * x * p, yp + weight * y * p, p1 + weight * p
    A, b = np.zeros((3, 3)), np.empty(3)
    A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2] = xx, xy, x1, yy, y1, one
    b[0], b[1], b[2] = xp, yp, p1
    return A, b


@numba.njit(cache=True, nogil=True, error_model="numpy")
def mark_within(columns: F64, chosen: Bool, x: float, y: float, z: float, least: float, inside: Bool) -> bool:
    """Mark the chosen cells whose normal's cosine with (x, y, z) is above `least`; whether these are others than were marked."""
    nx, ny, nz = columns[5], columns[6], columns[7]
    changed = 0
    for k in range(len(inside)):
        counts = chosen[k] & (nx[k] * x + ny[k] * y + nz[k] * z > least)
        changed += counts != inside[k]
        inside[k] = counts
    return changed > 0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sum_marked(columns: F64, inside: Bool) -> tuple[float, float, float]:
    """Sum of the normals of the marked cells."""
    nx, ny, nz = columns[5], columns[6], columns[7]
    a, b, c = 0.0, 0.0, 0.0
    for k in range(len(inside)):
        a, b, c = a + (nx[k] if inside[k] else 0.0), b + (ny[k] if inside[k] else 0.0), c + (nz[k] if inside[k] else 0.0)
    return a, b, c
