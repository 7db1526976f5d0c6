"""Which planar regions are parts of one plane."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F64, I32, U8
from trihedron.plugins.numerics.algebra.ranking import descending
from trihedron.plugins.numerics.depth.organised_grid import Grid
from trihedron.plugins.numerics.planes.parallel_planes import LEAST, angle_between
from trihedron.plugins.numerics.planes.plane_fitting import solve_symmetric
from trihedron.plugins.numerics.planes.plane_regions import accumulate, grow_regions

NOISE = 7.815  # χ² of a plane's three parameters, 95 %
PARALLEL = 4.0  # times less than the common plane is turned from either must two surfaces be turned from each other to be a step, not a bend


@numba.njit(cache=True, nogil=True, error_model="numpy")
def grown_and_merged(
    core: U8, planes: F64, grid: Grid, gate: float, reach: int, cos_cone: float, gap: int, limit: float, alike: float
) -> tuple[U8, I32, tuple[F64, F64, F64, I32]]:
    """Labels (h, w) grown from the `core` of each region as by `grow_regions`, which region each one becomes part of as by `merge_regions` where they
    come within `gap` cells of each other, and the sums over the cores."""
    labels, sums = grow_regions(core, planes, grid, gate, reach, cos_cone), accumulate(core, len(planes), grid)
    return labels, merge_regions(*sums, neighbours(labels, len(planes), gap), limit, alike), sums


@numba.njit(cache=True, nogil=True, error_model="numpy")
def neighbours(labels: U8, count: int, gap: int) -> F64:
    """(count, count) number of places where regions lie within `gap` cells of each other in a row or column."""
    h, w = labels.shape
    touch, last = np.zeros((count, count)), np.empty(w, np.bool_)
    for r in range(h):
        here, below = labels[r], labels[min(r + 1, h - 1)]
        for c in range(w):
            last[c] = (here[c] > 0) & (below[c] != here[c])
        for c in range(w - 1):
            last[c] |= (here[c] > 0) & (here[c + 1] != here[c])
        for c in range(w):
            if not last[c]:
                continue
            a = here[c]
            for down, right in ((0, 1), (1, 0)):
                for k in range(1, min(gap, (h - 1 - r) * down + (w - 1 - c) * right) + 1):
                    b = labels[r + k * down, c + k * right]
                    if b == a:
                        break
                    if b > 0:
                        touch[a - 1, b - 1] += 1.0
                        touch[b - 1, a - 1] += 1.0
                        break
    return touch


@numba.njit(cache=True, nogil=True, error_model="numpy")
def merge_regions(A: F64, b: F64, moments: F64, n: I32, touch: F64, limit: float, alike: float) -> I32:
    """Which region each of k becomes part of, (k + 1,) by label; the sums (as from `accumulate`, with the neighbours' counts) are added up in place.

    From the largest down a region takes in those smaller neighbours for which the common plane is within `limit` σ (rms) of each one's own, and what
    noise moves these by when `alike` depths err as one."""
    k = len(n)
    sums = A.reshape(k, 9), b, moments.reshape(k, 16), touch
    owner = np.arange(k + 1).astype(np.int32)
    for i in descending(n.astype(np.float64)):
        again = owner[i + 1] == i + 1
        while again:
            again = False
            for j in range(k):
                if touch[i, j] == 0.0 or j == i or owner[j + 1] != j + 1 or n[j] > n[i]:
                    continue
                if not _one_plane(A[i], b[i], n[i], A[j], b[j], n[j], limit, NOISE * alike):
                    continue
                for rows in sums:
                    for c in range(rows.shape[1]):
                        rows[i, c] += rows[j, c]
                n[i] += n[j]
                again = True
                for label in range(k + 1):
                    if owner[label] == j + 1:
                        owner[label] = i + 1
    return owner


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _one_plane(A: F64, b: F64, n: int, B: F64, c: F64, m: int, limit: float, noise: float) -> bool:
    """Whether the common plane of two regions lies within `limit` σ (rms) of each region's own; `noise` is added to the sums of squares. Not when it
    is turned from both while these are parallel: one surface is in front of the other."""
    solved, common = solve_symmetric(A + B, b + c)
    first, p = solve_symmetric(A, b)
    second, q = solve_symmetric(B, c)
    if not (solved and first and second):
        return False
    e, f = common - p, common - q
    turned = min(angle_between(common, p), angle_between(common, q))
    step = turned > LEAST and turned > PARALLEL * angle_between(p, q)
    return not step and e @ (A @ e) < limit * limit * n + noise and f @ (B @ f) < limit * limit * m + noise
