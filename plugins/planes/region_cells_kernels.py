"""Kernels of the cells of a region as an array, and of least squares over them.

Cells are gathered once into an array (8, n), whose rows are named below: loops over contiguous numbers are vectorised.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.shared.depth_image_kernels import Grid

# Rows of the array
X, Y = 0, 1  # x/z and y/z of the ray
RHO = 2  # inverse depth, 1/m
SIGMA = 3  # its standard deviation, 1/m
WEIGHT = 4  # depths in the cell over σ²
NX, NY, NZ = 5, 6, 7  # unit normal

MIN_SAMPLE = 2000  # cells that represent a region in all rounds of a fit but the last


@kernel
def gather_cells(grid: Grid, cells: I32) -> F64:
    """Gather cells of the grid, whose flat numbers ascend, into an array (8, n)."""
    rho, sigma, count, normals = grid.rho.ravel(), grid.sigma.ravel(), grid.count.ravel(), grid.normals.reshape(-1, 3)
    out, w = np.empty((8, len(cells))), len(grid.rays_x)
    r = 0
    for k in range(len(cells)):
        i = cells[k]
        while i >= (r + 1) * w:
            r += 1
        out[X, k], out[Y, k], out[RHO, k], out[SIGMA, k] = grid.rays_x[i - r * w], grid.rays_y[r], rho[i], sigma[i]
        out[WEIGHT, k], out[NX, k], out[NY, k], out[NZ, k] = np.int32(count[i]) / (sigma[i] * sigma[i]), normals[i, 0], normals[i, 1], normals[i, 2]
    return out


@kernel
def subsample(columns: F64) -> F64:
    """Take every i-th cell, with the largest i that leaves at least MIN_SAMPLE."""
    step = max(columns.shape[1] // MIN_SAMPLE, 1)
    if step == 1:
        return columns
    out = np.empty((8, (columns.shape[1] + step - 1) // step))
    for j in range(8):
        for k in range(out.shape[1]):
            out[j, k] = columns[j, k * step]
    return out


@kernel
def subsample_marks(marks: Bool) -> Bool:
    """Marks (n,) of the cells that `subsample` takes."""
    return marks[:: max(len(marks) // MIN_SAMPLE, 1)].copy()


@kernel
def normal_equations(columns: F64, chosen: Bool) -> tuple[F64, F64]:
    """Normal equations of q, from the weighted depths of the chosen cells: A (3, 3), of which only the upper triangle is filled, and b (3,)."""
    xs, ys, rho, weights = columns[X], columns[Y], columns[RHO], columns[WEIGHT]
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


@kernel
def solve_symmetric(A: F64, b: F64) -> tuple[bool, F64]:
    """Solution (3,) of a symmetric positive definite 3 × 3 system by cofactors; False, and zeros, when it is singular."""
    c00, c01, c02 = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2], A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2], A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1]
    c11, c12, c22 = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2], A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2], A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    det = A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02
    x = np.zeros(3)
    if not det > 1e-14 * A[0, 0] * A[1, 1] * A[2, 2]:
        return False, x
    x[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / det
    x[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / det
    x[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / det
    return True, x


@kernel
def angle_between(q: F64, normal: F64) -> float:
    """Acute angle (rad) between the normals of two planes, of any length; NaN for no plane or no normal."""
    sine, one, other = 0.0, 0.0, 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        sine += (q[i] * normal[j] - q[j] * normal[i]) ** 2
        one, other = one + q[k] * q[k], other + normal[k] * normal[k]
    squares = one * other
    return float(np.arcsin(min(np.sqrt(sine / squares), 1.0))) if squares > 0.0 else np.nan


@kernel
def mark_within(columns: F64, chosen: Bool, x: float, y: float, z: float, least: float, inside: Bool) -> bool:
    """Mark the chosen cells whose normal's cosine with (x, y, z) is above `least`; returns True if these differ from those marked before."""
    nx, ny, nz = columns[NX], columns[NY], columns[NZ]
    changed = 0
    for k in range(len(inside)):
        counts = chosen[k] & (nx[k] * x + ny[k] * y + nz[k] * z > least)
        changed += counts != inside[k]
        inside[k] = counts
    return changed > 0


@kernel
def sum_marked(columns: F64, inside: Bool) -> tuple[float, float, float]:
    """Sum of the normals of the marked cells."""
    nx, ny, nz = columns[NX], columns[NY], columns[NZ]
    a, b, c = 0.0, 0.0, 0.0
    for k in range(len(inside)):
        a, b, c = a + (nx[k] if inside[k] else 0.0), b + (ny[k] if inside[k] else 0.0), c + (nz[k] if inside[k] else 0.0)
    return a, b, c
