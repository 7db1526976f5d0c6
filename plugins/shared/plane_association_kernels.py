"""Numba kernels of `plane_association.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32


@kernel
def mean_distance(plane: F64, samples: F32) -> float:
    """Mean |n·x + d| over the finite rows of (s, 3) samples; inf without any."""
    nx, ny, nz, d = plane[0], plane[1], plane[2], plane[3]
    total, count = 0.0, 0
    for k in range(len(samples)):
        x = nx * samples[k, 0] + ny * samples[k, 1] + nz * samples[k, 2] + d
        if np.isfinite(x):
            total += abs(x)
            count += 1
    return total / count if count else np.inf


@kernel
def _spacing(samples: F32) -> float:
    """Mean distance from a sample to its nearest neighbour, metres; 0 with fewer than two."""
    total, count = 0.0, 0
    nearest = np.full(len(samples), np.inf, np.float32)
    for i in range(len(samples)):
        x, y, z = samples[i, 0], samples[i, 1], samples[i, 2]
        for j in range(i):
            squared = (x - samples[j, 0]) ** 2 + (y - samples[j, 1]) ** 2 + (z - samples[j, 2]) ** 2
            if squared < nearest[i]:  # not with NaN
                nearest[i] = squared
            if squared < nearest[j]:
                nearest[j] = squared
    for i in range(len(samples)):
        if nearest[i] < np.inf:
            total += np.sqrt(float(nearest[i]))
            count += 1
    return total / count if count else 0.0


@kernel
def overlap(samples_a: F32, samples_b: F32, reach_m: float) -> float:
    """Share of the finite samples of a that have a sample of b within `reach_m`."""
    near, count = 0, 0
    for i in range(len(samples_a)):
        x, y, z = samples_a[i, 0], samples_a[i, 1], samples_a[i, 2]
        if not np.isfinite(x):
            continue
        count += 1
        for j in range(len(samples_b)):
            if (x - samples_b[j, 0]) ** 2 + (y - samples_b[j, 1]) ** 2 + (z - samples_b[j, 2]) ** 2 <= reach_m * reach_m:  # not with NaN
                near += 1
                break
    return near / count if count else 0.0


@kernel
def associated(a: F64, samples_a: F32, b: F64, samples_b: F32, cosine: float, limit: float, many_to_one: bool) -> I32:
    """`associate_planes` by the cosine of its angle and its distance (m): the pair that costs least, then the next among the rows that are left."""
    n, m = len(a), len(b)
    cost = np.full((n, m), np.inf)
    reach = np.full(m, -1.0)
    for i in range(n):
        for j in range(m):
            if not a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2] >= cosine:
                continue
            distance = min(mean_distance(b[j], samples_a[i]), mean_distance(a[i], samples_b[j]))
            if distance > limit:
                continue
            if reach[j] < 0.0:
                reach[j] = max(1.5 * _spacing(samples_b[j]), limit)
            cost[i, j] = distance / max(limit, 1e-9) + 1.0 - overlap(samples_a[i], samples_b[j], reach[j])
    pairs = np.full(n, -1, np.int32)
    while True:
        best, row, column = np.inf, -1, -1
        for i in range(n):
            for j in range(m):
                if cost[i, j] < best:
                    best, row, column = cost[i, j], i, j
        if row < 0:
            break
        pairs[row] = column
        cost[row, :] = np.inf
        if not many_to_one:
            cost[:, column] = np.inf
    rows = np.flatnonzero(pairs >= 0)
    out = np.empty((len(rows), 2), np.int32)
    for k in range(len(rows)):
        out[k, 0], out[k, 1] = rows[k], pairs[rows[k]]
    return out


@kernel
def moved_planes(planes: F64, samples_m: F32, R: F64, t: F64) -> tuple[F64, F32]:
    """Planes (p, 4) and points on them (p, s, 3) where the motion `p -> R p + t` puts them."""
    coefficients, samples = np.empty((len(planes), 4)), np.empty((len(planes), samples_m.shape[1], 3), np.float32)
    for i in range(len(planes)):
        coefficients[i, 3] = planes[i, 3]
        for a in range(3):
            coefficients[i, a] = R[a, 0] * planes[i, 0] + R[a, 1] * planes[i, 1] + R[a, 2] * planes[i, 2]
            coefficients[i, 3] -= coefficients[i, a] * t[a]
            for k in range(samples_m.shape[1]):
                samples[i, k, a] = R[a, 0] * samples_m[i, k, 0] + R[a, 1] * samples_m[i, k, 1] + R[a, 2] * samples_m[i, k, 2] + t[a]
    return coefficients, samples
