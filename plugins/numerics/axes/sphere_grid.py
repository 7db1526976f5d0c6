"""Cells on the sphere, antipodes being one: a cube's three faces, each divided n by n in its own plane (gnomonic projection).

Cell `(face · n + i) · n + j` holds the directions d whose largest component is `d[face]` and whose next two, divided by it, fall into the i-th and
j-th of n parts of [-1, 1]. Finding a direction's cell costs two divisions; a cell is 2/n rad wide in the middle of a face, half of that in a corner.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32


class SphereGrid(NamedTuple):
    """Centres (3n², 3), unit, and radii (3n²,), rad: how far from its centre a cell reaches."""

    centres: F64
    radii: F64


class Neighbours(NamedTuple):
    """Cells near each cell: those of cell j are `cells[first[j] : first[j + 1]]`."""

    first: I32
    cells: I32


def sphere_grid(n: int) -> SphereGrid:
    """The grid with n by n cells a face."""
    edges = np.linspace(-1.0, 1.0, n + 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    centres = _on_faces(middles, middles)
    # a cell is a convex quadrangle, so its corners are furthest from any of its points
    corners = [_on_faces(u, v) for u in (edges[:-1], edges[1:]) for v in (edges[:-1], edges[1:])]
    radii = [np.arccos(np.clip((centres * corner).sum(axis=1), -1.0, 1.0)) for corner in corners]
    return SphereGrid(centres, np.max(radii, axis=0))


def _on_faces(u: F64, v: F64) -> F64:
    """(3 · len(u) · len(v), 3) unit directions at every (u, v) of the three faces."""
    out = np.empty((3, len(u), len(v), 3))
    for face in range(3):
        out[face, :, :, face] = 1.0
        out[face, :, :, (face + 1) % 3] = u[:, None]
        out[face, :, :, (face + 2) % 3] = v
    out /= np.linalg.norm(out, axis=-1, keepdims=True)
    return out.reshape(-1, 3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def cell_of(x: float, y: float, z: float, n: int) -> int:
    """The cell of a direction, which may have any length but 0."""
    if abs(x) >= abs(y) and abs(x) >= abs(z):
        face, u, v = 0, y / x, z / x
    elif abs(y) >= abs(z):
        face, u, v = 1, z / y, x / y
    else:
        face, u, v = 2, x / z, y / z
    i, j = min(int(0.5 * n * (u + 1.0)), n - 1), min(int(0.5 * n * (v + 1.0)), n - 1)
    return (face * n + i) * n + j


@numba.njit(cache=True, nogil=True, error_model="numpy")
def neighbours(grid: SphereGrid, reach: float) -> Neighbours:
    """For each cell those with a point within `reach` (rad) of one of its own."""
    centres, radii = grid
    count, largest = len(centres), 0.0
    for j in range(count):
        largest = max(largest, radii[j])
    floor = np.cos(min(reach + 2.0 * largest, 0.5 * np.pi))
    first = np.zeros(count + 1, np.int32)
    cells = np.empty(0, np.int32)
    for fill in range(2):  # counted, then written
        total = 0
        for j in range(count):
            for k in range(count):
                dot = abs(centres[j, 0] * centres[k, 0] + centres[j, 1] * centres[k, 1] + centres[j, 2] * centres[k, 2])
                if dot > floor and np.arccos(min(dot, 1.0)) <= reach + radii[j] + radii[k] + 1e-9:
                    if fill == 1:
                        cells[total] = k
                    total += 1
            first[j + 1] = total
        if fill == 0:
            cells = np.empty(total, np.int32)
    return Neighbours(first, cells)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def largest_near(values: F64, near: Neighbours) -> F64:
    """For each cell the largest of `values` (cells,) on its neighbours."""
    out = np.empty(len(values))
    for j in range(len(values)):
        largest = -np.inf
        for k in range(near.first[j], near.first[j + 1]):
            largest = max(largest, values[near.cells[k]])
        out[j] = largest
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def coarser(values: F64, n: int) -> F64:
    """The largest of each 2 by 2 cells: values on the grid of n / 2, n being even."""
    half = n // 2
    out = np.full(3 * half * half, -np.inf)
    for cell in range(3 * n * n):
        face, i, j = cell // (n * n), cell // n % n, cell % n
        above = (face * half + i // 2) * half + j // 2
        out[above] = max(out[above], values[cell])
    return out
