"""Kernels that separate parallel surfaces a few centimetres apart (a door, a board on a wall) that pass for one plane within the noise.

The plane fitted to both tilts gradually from one to the other, while the mean of thousands of normals stays that of either. Where the two disagree,
two planes are fitted to the depths.
"""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import solve_positive
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.planes.region_cells_kernels import angle_between, mark_within, normal_equations, subsample_marks, sum_marked
from trihedron.plugins.shared.depth_image_kernels import Grid

MIN_DISAGREEMENT = np.radians(0.4)  # angle between mean normal and plane above which two planes are tried
WIDE_CONE, NARROW_CONE = np.cos(np.radians([15.0, 8.0]))  # normals outside, in the first and later rounds, come from patches across a step
MAX_DISAGREEMENT_RATIO = 0.5  # the larger plane's angle from the mean normal over that of the single plane; the smaller plane's must be below 1
MIN_SHARE = 0.1  # of the cells, in the smaller surface
RADIUS = 2  # cells, half-width of the square that distances are averaged over
MAX_ROUNDS = 10  # of 2-means clustering


@kernel
def larger_surface(q: F64, grid: Grid, cells: I32, columns: F64, sample: F64, member: Bool) -> tuple[F64, int, F64]:
    """Separate the members of a region with plane q into two parallel surfaces, if they are, and keep the larger one.

    Returns its q and number of members, which alone stay marked, and the q of the other; for a single surface q and members are unchanged, and the
    other q is zeros. The normals are tested on `sample`, the subsampled columns."""
    members, none = 0, np.zeros(3)
    for k in range(len(cells)):
        members += member[k]
    normal = _mean_normal(q, sample, subsample_marks(member))
    apart = angle_between(q, normal)
    if not apart > MIN_DISAGREEMENT:
        return q, members, none
    farther = _mark_farther(_distances(normal, grid, cells, member), member)
    one, other = 0, 0
    for k in range(len(cells)):
        one += member[k] and farther[k]
        other += member[k] and not farther[k]
    if min(one, other) < MIN_SHARE * members:
        return q, members, none
    first = _fit_marked(columns, member & (farther == (one >= other)))
    second = _fit_marked(columns, member & (farther != (one >= other)))
    if not (angle_between(first, normal) < MAX_DISAGREEMENT_RATIO * apart and angle_between(second, normal) < apart):
        return q, members, none
    for k in range(len(cells)):
        member[k] = member[k] and farther[k] == (one >= other)
    return first, max(one, other), second


@kernel
def _mean_normal(q: F64, columns: F64, member: Bool) -> F64:
    """Unit mean of the members' normals without those of patches across a step; NaN without any."""
    length = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    x, y, z = -q[0] / length, -q[1] / length, -q[2] / length
    inside = np.zeros(len(member), np.bool_)
    for k, least in enumerate((WIDE_CONE, NARROW_CONE, NARROW_CONE)):
        if not mark_within(columns, member, x, y, z, least, inside) and k > 0:
            break  # the same normals as before, and so the same mean
        a, b, c = sum_marked(columns, inside)
        length = np.sqrt(a * a + b * b + c * c)
        x, y, z = a / length, b / length, c / length
    return np.array([x, y, z])


@kernel
def _distances(normal: F64, grid: Grid, cells: I32, member: Bool) -> F64:
    """Signed distances (n,) along the normal, negative, each the mean over the members in a square around the cell; 0 for non-members."""
    w = grid.rho.shape[1]
    top, left, height, width = _bounding_box(cells, w)
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
            a, b, d, e = max(r - RADIUS, 0), min(r + RADIUS + 1, height), max(c - RADIUS, 0), min(c + RADIUS + 1, width)
            out[k] = (sums[b, e] - sums[a, e] - sums[b, d] + sums[a, d]) / (counts[b, e] - counts[a, e] - counts[b, d] + counts[a, d])
    return out


@kernel
def _bounding_box(cells: I32, w: int) -> tuple[int, int, int, int]:
    """Bounding box (top, left, height, width) of cells of a grid of w columns."""
    top, bottom, left, right = cells[0] // w, 0, w, 0
    for i in cells:
        r = i // w
        c = i - r * w
        top, bottom, left, right = min(top, r), max(bottom, r), min(left, c), max(right, c)
    return top, left, bottom - top + 1, right - left + 1


@kernel
def _mark_farther(distances: F64, member: Bool) -> Bool:
    """Mark (n,) the members in the farther of two clusters of distances (2-means)."""
    out = np.zeros(len(distances), np.bool_)
    total, square, n = 0.0, 0.0, 0
    for k in range(len(distances)):
        if member[k]:
            n, total, square = n + 1, total + distances[k], square + distances[k] ** 2
    spread = np.sqrt(max(square / n - (total / n) ** 2, 0.0))
    near, far = total / n + spread, total / n - spread
    for _ in range(MAX_ROUNDS):
        middle, sums, count, changed = 0.5 * (near + far), 0.0, 0, 0
        for k in range(len(distances)):
            farther = distances[k] < middle
            count += farther
            changed += farther != out[k]
            out[k] = farther
        if count == 0 or count == n or changed == 0:
            break
        for k in range(len(distances)):
            sums += distances[k] if out[k] else 0.0
        near, far = (total - sums) / (n - count), sums / count
    return out


@kernel
def _fit_marked(columns: F64, chosen: Bool) -> F64:
    """q (3,) of the plane through the chosen cells, zeros when there is none."""
    q = np.zeros(3)
    A, b = normal_equations(columns, chosen)
    solve_positive(A.T, b, q)
    return q
