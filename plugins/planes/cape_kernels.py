"""Numba kernels of `cape.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32, Bool
from trihedron.plugins.planes.blocks_kernels import SUMS, block_mse, block_plane

# Growing of planes over blocks from the commonest directions (Proença & Gao, IROS 2018).

BINS = 20  # of the polar and of the azimuth angle in the histogram of directions, Proença & Gao


@kernel
def grow_blocks(sums: F64, q: F64, mse: F64, limit: float, cos_angle: float, gate: float, least: int) -> tuple[I32, F64]:
    """Labels (rows, cols) of the blocks, 0 = none, and q (k, 3) of their planes.

    `sums`, `q` and `mse` as from `block_sums` and `block_planes`; a block is planar when its mse is below `limit`. Again and again the flattest block
    of the fullest bin of directions is the seed of a region, which takes in neighbours whose normal, and mse about the plane of the block they are
    reached from, are within `cos_angle` and `gate`. A region is kept when `least` blocks fit its common plane; those that do not are free again."""
    rows, cols = mse.shape
    n = rows * cols
    flat, planes, flatness = sums.reshape(n, SUMS), q.reshape(n, 3), mse.reshape(n)
    free = flatness < limit
    normal, bins, histogram = _directions(planes, free)
    labels, found = np.zeros(n, np.int32), 0
    out = np.zeros((n // least + 1, 3))
    while True:
        fullest = int(np.argmax(histogram))
        if histogram[fullest] < least:
            break
        seed = _flattest(flatness, bins, free, fullest)
        members = _region(seed, flat, planes, normal, free, rows, cols, cos_angle, gate)
        a, b, c, fitting = _common_plane(flat, members, limit)
        if fitting < least:
            free[seed] = False
            histogram[fullest] -= 1
            continue
        out[found, 0], out[found, 1], out[found, 2] = a, b, c
        found += 1
        for i in members:
            if block_mse(flat[i], a, b, c) < limit:
                labels[i], free[i] = found, False
                histogram[bins[i]] -= 1
        if free[seed]:
            free[seed] = False
            histogram[fullest] -= 1
    return labels.reshape(rows, cols), out[:found]


@kernel
def _directions(planes: F64, free: Bool) -> tuple[F64, I32, I32]:
    """Unit normals (n, 3) of the planes q, the bin of each, and the histogram of the free ones."""
    normal, bins, histogram = np.zeros_like(planes), np.zeros(len(planes), np.int32), np.zeros(BINS * BINS, np.int32)
    for i in range(len(planes)):
        if not free[i]:
            continue
        length = np.sqrt(planes[i, 0] ** 2 + planes[i, 1] ** 2 + planes[i, 2] ** 2)
        for k in range(3):
            normal[i, k] = -planes[i, k] / length
        polar, azimuth = np.arccos(min(max(-normal[i, 2], -1.0), 1.0)), np.arctan2(normal[i, 1], normal[i, 0]) + np.pi
        u, v = min(int(polar / np.pi * 2.0 * BINS), BINS - 1), min(int(azimuth / (2.0 * np.pi) * BINS), BINS - 1)
        bins[i] = u * BINS + (v if u > 0 else 0)  # straight ahead the azimuth means nothing
        histogram[bins[i]] += 1
    return normal, bins, histogram


@kernel
def _flattest(flatness: F64, bins: I32, free: Bool, wanted: int) -> int:
    """The free block of a bin with the least mse."""
    best = -1
    for i in range(len(bins)):
        if free[i] and bins[i] == wanted and (best < 0 or flatness[i] < flatness[best]):
            best = i
    return best


@kernel
def _region(seed: int, flat: F64, planes: F64, normal: F64, free: Bool, rows: int, cols: int, cos_angle: float, gate: float) -> I32:
    """The free blocks reached from the seed, each like the one it was reached from."""
    n = rows * cols
    inside, queue, size = np.zeros(n, np.bool_), np.empty(n, np.int32), 1
    queue[0], inside[seed] = seed, True
    k = 0
    while k < size:
        i = queue[k]
        k += 1
        for step, possible in ((-cols, i >= cols), (-1, i % cols > 0), (1, i % cols < cols - 1), (cols, i < n - cols)):
            if not possible or not free[i + step] or inside[i + step]:
                continue
            j = i + step
            if normal[i, 0] * normal[j, 0] + normal[i, 1] * normal[j, 1] + normal[i, 2] * normal[j, 2] < cos_angle:
                continue
            if block_mse(flat[j], planes[i, 0], planes[i, 1], planes[i, 2]) < gate:
                queue[size], inside[j] = j, True
                size += 1
    return queue[:size]


@kernel
def _common_plane(flat: F64, members: I32, limit: float) -> tuple[float, float, float, int]:
    """q of the plane through the blocks, without those that do not fit it (three rounds), and the number that do."""
    total, kept = np.zeros(SUMS), len(members)
    for i in members:
        for k in range(SUMS):
            total[k] += flat[i, k]
    a, b, c, mse = block_plane(total)
    for _ in range(3):
        if not mse < np.inf:
            return a, b, c, 0
        x, y, z, kept = a, b, c, 0
        total[:] = 0.0
        for i in members:
            if block_mse(flat[i], x, y, z) < limit:
                kept += 1
                for k in range(SUMS):
                    total[k] += flat[i, k]
        a, b, c, mse = block_plane(total)
    return a, b, c, kept
