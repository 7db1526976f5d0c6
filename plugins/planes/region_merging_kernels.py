"""Kernels that merge planar regions that are parts of one plane."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot, matvec
from trihedron.pipeline.core.types import F64, I32, U8
from trihedron.plugins.planes.parallel_surfaces_kernels import MIN_DISAGREEMENT
from trihedron.plugins.planes.region_cells_kernels import angle_between, solve_symmetric
from trihedron.plugins.planes.region_growing_kernels import grow_regions
from trihedron.plugins.planes.region_sums_kernels import accumulate
from trihedron.plugins.shared.depth_image_kernels import Grid
from trihedron.plugins.shared.sorting_kernels import descending

CHI2_PLANE = 7.815  # χ² of a plane's three parameters, 95 %
PARALLEL_RATIO = 4.0  # a step: the common plane is tilted from each surface by more than this times the angle between the two


@kernel
def grow_and_merge(
    core: U8, planes: F64, grid: Grid, gate: float, reach: int, cos_cone: float, gap: int, limit: float, correlated: float
) -> tuple[U8, I32, tuple[F64, F64, F64, I32]]:
    """Grow regions from their cores and merge those that are one plane.

    Returns labels (h, w) as from `grow_regions`, the new label (k + 1,) of each region as from `merge_regions` for regions within `gap` cells of each
    other, and the sums over the cores as from `accumulate`."""
    labels, sums = grow_regions(core, planes, grid, gate, reach, cos_cone), accumulate(core, len(planes), grid)
    return labels, merge_regions(*sums, count_adjacent(labels, len(planes), gap), limit, correlated), sums


@kernel
def count_adjacent(labels: U8, count: int, gap: int) -> F64:
    """(count, count) number of places where regions lie within `gap` cells of each other in a row or column."""
    h, w = labels.shape
    adjacent, last = np.zeros((count, count)), np.empty(w, np.bool_)
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
                        adjacent[a - 1, b - 1] += 1.0
                        adjacent[b - 1, a - 1] += 1.0
                        break
    return adjacent


@kernel
def merge_regions(A: F64, b: F64, moments: F64, n: I32, adjacent: F64, limit: float, correlated: float) -> I32:
    """Merge k regions greedily; returns the new label (k + 1,) of each. The sums (as from `accumulate`) and the counts `adjacent` are added in place.

    From the largest down, a region absorbs smaller adjacent ones if the common plane is within `limit` σ (rms) of each region's own, plus what noise
    moves these by when the errors of `correlated` depths are one."""
    k = len(n)
    sums = A.reshape(k, 9), b, moments.reshape(k, 16), adjacent
    owner = np.arange(k + 1).astype(np.int32)
    for i in descending(n.astype(np.float64)):
        again = owner[i + 1] == i + 1
        while again:
            again = False
            for j in range(k):
                if adjacent[i, j] == 0.0 or j == i or owner[j + 1] != j + 1 or n[j] > n[i]:
                    continue
                if not _one_plane(A[i], b[i], n[i], A[j], b[j], n[j], limit, CHI2_PLANE * correlated):
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


@kernel
def _one_plane(A: F64, b: F64, n: int, B: F64, c: F64, m: int, limit: float, noise: float) -> bool:
    """Return True if the common plane of two regions lies within `limit` σ (rms) of each region's own; `noise` is added to the sums of squares. False
    when it is tilted from both while these are parallel: one surface is in front of the other."""
    solved, common = solve_symmetric(A + B, b + c)
    first, p = solve_symmetric(A, b)
    second, q = solve_symmetric(B, c)
    if not (solved and first and second):
        return False
    e, f = common - p, common - q
    tilt = min(angle_between(common, p), angle_between(common, q))
    step = tilt > MIN_DISAGREEMENT and tilt > PARALLEL_RATIO * angle_between(p, q)
    return not step and dot(e, matvec(A, e)) < limit * limit * n + noise and dot(f, matvec(B, f)) < limit * limit * m + noise
