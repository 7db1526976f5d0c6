"""Parallel surfaces a few centimetres apart (a door, a board on a wall) that noise lets pass for one plane, told by the normals and taken apart.

The plane fitted to both leans from one to the other by degrees, while the mean of thousands of normals stays that of either: where the two disagree
the depths are tried as two planes.
"""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.numerics.algebra.small_linear import solve_positive
from trihedron.plugins.numerics.depth.organised_grid import Grid
from trihedron.plugins.numerics.planes.cell_columns import mark_within, normal_equations, sum_marked, thinned_marks

LEAST = np.radians(0.4)  # disagreement of normals and plane that is looked into
WIDE, NARROW = np.cos(np.radians([15.0, 8.0]))  # normals further from their mean, then from that of these, are of a patch across a step
SMALLER = 0.5  # the larger of the two planes must disagree by less than this share of what the one did, the smaller by less at all
SHARE = 0.1  # of the cells that the smaller of the two must have
REACH = 2  # cells on each side that distances are averaged over
ROUNDS = 10  # of two means


@numba.njit(cache=True, nogil=True, error_model="numpy")
def larger_surface(q: F64, grid: Grid, cells: I32, columns: F64, some: F64, member: Bool) -> tuple[F64, int, F64]:
    """Of the members of a region with plane q, when they are two parallel surfaces, the larger one: its q and number of members, which alone stay
    marked, and the q of the other. Otherwise all is left as it is, and there is no other (zeros). `some` of the columns show whether they may be."""
    members, none = 0, np.zeros(3)
    for k in range(len(cells)):
        members += member[k]
    normal = _mean_normal(q, some, thinned_marks(member))
    apart = angle_between(q, normal)
    if not apart > LEAST:
        return q, members, none
    further = _further(_distances(normal, grid, cells, member), member)
    one, other = 0, 0
    for k in range(len(cells)):
        one += member[k] and further[k]
        other += member[k] and not further[k]
    if min(one, other) < SHARE * members:
        return q, members, none
    first = _fitted(columns, member & (further == (one >= other)))
    second = _fitted(columns, member & (further != (one >= other)))
    if not (angle_between(first, normal) < SMALLER * apart and angle_between(second, normal) < apart):
        return q, members, none
    for k in range(len(cells)):
        member[k] = member[k] and further[k] == (one >= other)
    return first, max(one, other), second


@numba.njit(cache=True, nogil=True, error_model="numpy")
def angle_between(q: F64, normal: F64) -> float:
    """Acute angle (rad) between the normals of two planes, of any length; NaN for no plane or no normal."""
    sine, one, other = 0.0, 0.0, 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        sine += (q[i] * normal[j] - q[j] * normal[i]) ** 2
        one, other = one + q[k] * q[k], other + normal[k] * normal[k]
    squares = one * other
    return float(np.arcsin(min(np.sqrt(sine / squares), 1.0))) if squares > 0.0 else np.nan


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mean_normal(q: F64, columns: F64, member: Bool) -> F64:
    """Unit mean of the normals of the members, those across a step left out; NaN without any."""
    length = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    x, y, z = -q[0] / length, -q[1] / length, -q[2] / length
    inside = np.zeros(len(member), np.bool_)
    for k, least in enumerate((WIDE, NARROW, NARROW)):
        if not mark_within(columns, member, x, y, z, least, inside) and k > 0:
            break  # the same normals as before, and so the same mean
        a, b, c = sum_marked(columns, inside)
        length = np.sqrt(a * a + b * b + c * c)
        x, y, z = a / length, b / length, c / length
    return np.array([x, y, z])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _distances(normal: F64, grid: Grid, cells: I32, member: Bool) -> F64:
    """(n,) how far along the normal the members about each member are from the camera, negative, on average over a square; 0 for the others."""
    w = grid.rho.shape[1]
    top, left, height, width = _box(cells, w)
    sums, counts = np.zeros((height + 1, width + 1)), np.zeros((height + 1, width + 1), np.int32)
    for k in range(len(cells)):
        if member[k]:
            r = cells[k] // w
            c = cells[k] - r * w
            sums[r - top + 1, c - left + 1] = (normal[0] * grid.rays_x[c] + normal[1] * grid.rays_y[r] + normal[2]) / grid.rho[r, c]
            counts[r - top + 1, c - left + 1] = 1
    for r in range(1, height + 1):
        total, n = 0.0, 0
        for c in range(1, width + 1):
            total, n = total + sums[r, c], n + counts[r, c]
            sums[r, c], counts[r, c] = sums[r - 1, c] + total, counts[r - 1, c] + n
    out = np.zeros(len(cells))
    for k in range(len(cells)):
        if member[k]:
            r = cells[k] // w
            r, c = r - top, cells[k] - r * w - left
            a, b, d, e = max(r - REACH, 0), min(r + REACH + 1, height), max(c - REACH, 0), min(c + REACH + 1, width)
            out[k] = (sums[b, e] - sums[a, e] - sums[b, d] + sums[a, d]) / (counts[b, e] - counts[a, e] - counts[b, d] + counts[a, d])
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _box(cells: I32, w: int) -> tuple[int, int, int, int]:
    """Top, left, height and width of the rectangle about cells of a grid of w columns."""
    top, bottom, left, right = cells[0] // w, 0, w, 0
    for i in cells:
        r = i // w
        c = i - r * w
        top, bottom, left, right = min(top, r), max(bottom, r), min(left, c), max(right, c)
    return top, left, bottom - top + 1, right - left + 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _further(distances: F64, member: Bool) -> Bool:
    """(n,) which members have the further of two distances (two means)."""
    out = np.zeros(len(distances), np.bool_)
    total, square, n = 0.0, 0.0, 0
    for k in range(len(distances)):
        if member[k]:
            n, total, square = n + 1, total + distances[k], square + distances[k] ** 2
    spread = np.sqrt(max(square / n - (total / n) ** 2, 0.0))
    near, far = total / n + spread, total / n - spread
    for _ in range(ROUNDS):
        middle, sums, count, changed = 0.5 * (near + far), 0.0, 0, 0
        for k in range(len(distances)):
            further = distances[k] < middle
            count += further
            changed += further != out[k]
            out[k] = further
        if count == 0 or count == n or changed == 0:
            break
        for k in range(len(distances)):
            sums += distances[k] if out[k] else 0.0
        near, far = (total - sums) / (n - count), sums / count
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fitted(columns: F64, chosen: Bool) -> F64:
    """q (3,) of the plane through the chosen cells, zeros when there is none."""
    q = np.zeros(3)
    A, b = normal_equations(columns, chosen)
    solve_positive(A.T, b, q)
    return q
