"""Numba kernels of `descriptors.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, I32, U8

U64 = NDArray[np.uint64]
NONE, HAMMING, L2 = 0, 1, 2


@kernel
def _ones(x: int) -> int:
    """Number of bits set in a word."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


@kernel
def hamming(a: U64, b: U64) -> int:
    """Number of differing bits of two rows of words."""
    total = np.uint64(0)
    for k in range(len(a)):
        total += _ones(a[k] ^ b[k])
    return int(total)


@kernel
def _bits_apart(a: U64, i: int, b: U64, j: int) -> int:
    """`hamming` of row i of a and row j of b: for inner loops, where to slice them takes longer."""
    total = np.uint64(0)
    for k in range(a.shape[1]):
        total += _ones(a[i, k] ^ b[j, k])
    return int(total)


@kernel
def _euclidean(a: U8, i: int, b: U8, j: int) -> float:
    """Distance of row i of a and row j of b."""
    total = 0
    for k in range(a.shape[1]):
        step = int(a[i, k]) - int(b[j, k])
        total += step * step
    return float(np.sqrt(total))


@kernel
def _buckets(px: F32, cell: float, cols: int, rows: int, x0: float, y0: float) -> tuple[I32, I32]:
    """Counting sort of points into a grid: (cols·rows + 1,) starts and the row numbers in cell order; points with NaN are left out."""
    start = np.zeros(cols * rows + 1, np.int32)
    place = np.full(len(px), -1, np.int32)
    for i in range(len(px)):
        if np.isfinite(px[i, 0]) and np.isfinite(px[i, 1]):
            place[i] = min(int((px[i, 1] - y0) / cell), rows - 1) * cols + min(int((px[i, 0] - x0) / cell), cols - 1)
            start[place[i] + 1] += 1
    for c in range(cols * rows):
        start[c + 1] += start[c]
    fill = start.copy()
    order = np.empty(start[cols * rows], np.int32)
    for i in range(len(px)):
        if place[i] >= 0:
            order[fill[place[i]]] = i
            fill[place[i]] += 1
    return start, order


@kernel
def _bounds(px: F32) -> tuple[float, float, float, float]:
    """Smallest and largest finite x, y; (0, 0, -1, -1) when there is none."""
    x0, y0, x1, y1 = np.inf, np.inf, -np.inf, -np.inf
    for i in range(len(px)):
        x, y = px[i, 0], px[i, 1]
        if np.isfinite(x) and np.isfinite(y):
            x0, y0, x1, y1 = min(x0, x), min(y0, y), max(x1, x), max(y1, y)
    return (x0, y0, x1, y1) if x1 >= x0 else (0.0, 0.0, -1.0, -1.0)


@kernel
def near_matches(
    qpx: F32, qwords: U64, qbytes: U8, qoct: U8, tpx: F32, twords: U64, tbytes: U8, toct: U8,
    radius: F32, step: int, mode: int, limit: float, ratio: float,
) -> I32:  # fmt: skip
    """For each feature of q the row (n,) of the one of t within its radius, at most `step` octaves apart, that is most alike by `mode`; -1 without,
    where the distance is above `limit`, where another of its octave is alike by `ratio`, and where another of q is nearer to it."""
    out = np.full(len(qpx), -1, np.int32)
    x0, y0, x1, y1 = _bounds(tpx)
    if x1 < x0:
        return out
    cell = max(16.0, (x1 - x0) / 256.0, (y1 - y0) / 256.0)  # the grid stays small whatever the coordinates
    cols, rows = int((x1 - x0) / cell) + 1, int((y1 - y0) / cell) + 1
    start, order = _buckets(tpx, cell, cols, rows, x0, y0)
    owner = np.full(len(tpx), -1, np.int32)
    held = np.full(len(tpx), np.inf)
    near, apart = np.empty(len(tpx), np.int32), np.empty(len(tpx))
    places, octaves = np.empty((len(order), 2), np.float32), np.empty(len(order), np.int64)  # in the order of the grid
    for k in range(len(order)):
        places[k, 0], places[k, 1], octaves[k] = tpx[order[k], 0], tpx[order[k], 1], toct[order[k]]
    for i in range(len(qpx)):
        x, y, r = qpx[i, 0], qpx[i, 1], radius[i]
        if not (np.isfinite(x) and np.isfinite(y) and r >= 0.0) or x + r < x0 or x - r > x1 or y + r < y0 or y - r > y1:
            continue
        best, j, count = np.inf, -1, 0
        for row in range(max(int((y - r - y0) / cell), 0), min(int((y + r - y0) / cell), rows - 1) + 1):
            c0, c1 = max(int((x - r - x0) / cell), 0), min(int((x + r - x0) / cell), cols - 1)
            for k in range(start[row * cols + c0], start[row * cols + c1 + 1]):
                apart2 = (places[k, 0] - x) ** 2 + (places[k, 1] - y) ** 2
                if (apart2 > r * r) | (abs(octaves[k] - np.int64(qoct[i])) > step):
                    continue
                t = order[k]
                if mode == HAMMING:
                    distance = float(_bits_apart(qwords, i, twords, t))
                elif mode == L2:
                    distance = _euclidean(qbytes, i, tbytes, t)
                else:
                    distance = np.sqrt(apart2)
                near[count], apart[count] = t, distance
                count += 1
                if distance < best or (distance == best and t < j):
                    best, j = distance, t
        if j < 0 or (mode != NONE and best > limit) or best >= held[j]:
            continue
        rival = False
        for k in range(count):
            rival |= ratio < 1.0 and near[k] != j and toct[near[k]] == toct[j] and best >= ratio * apart[k]
        if rival:
            continue
        if owner[j] >= 0:
            out[owner[j]] = -1
        owner[j], held[j], out[i] = i, best, j
    return out


@kernel
def _directions(segments: F32) -> F64:
    """(n, 5): middle x, y, direction x, y, length; NaN for a segment without length or with NaN."""
    out = np.full((len(segments), 5), np.nan)
    for i in range(len(segments)):
        dx, dy = segments[i, 1, 0] - segments[i, 0, 0], segments[i, 1, 1] - segments[i, 0, 1]
        length = np.sqrt(dx * dx + dy * dy)
        if length > 1e-3:
            out[i, 0], out[i, 1] = 0.5 * (segments[i, 0, 0] + segments[i, 1, 0]), 0.5 * (segments[i, 0, 1] + segments[i, 1, 1])
            out[i, 2], out[i, 3], out[i, 4] = dx / length, dy / length, length
    return out


@kernel
def _beside(q: F64, i: int, t: F64, j: int) -> tuple[float, float]:
    """Offset (px) beside row i of q in the middle of the overlap with row j of t, and overlap as a share of the shorter segment (negative: apart)."""
    mx, my, dx, dy, length = t[j, 0] - q[i, 0], t[j, 1] - q[i, 1], q[i, 2], q[i, 3], q[i, 4]
    along, beside = mx * dx + my * dy, my * dx - mx * dy
    cosine = dx * t[j, 2] + dy * t[j, 3]
    half = 0.5 * t[j, 4] * abs(cosine)
    low, high = max(along - half, -0.5 * length), min(along + half, 0.5 * length)
    slope = (dx * t[j, 3] - dy * t[j, 2]) / cosine if abs(cosine) > 1e-6 else 0.0
    return abs(beside + (0.5 * (low + high) - along) * slope), (high - low) / min(length, t[j, 4])


@kernel
def line_matches(
    query: F32, qwords: U64, train: F32, twords: U64, sine_max: float, offset_px: float, overlap_min: float, mode: int, limit: float, ratio: float
) -> I32:
    """For each segment of `query` the row (n,) of the one of `train` beside it that is most alike by `mode`; -1 without, where the distance is above
    `limit`, where another edge is alike by `ratio`, and where another segment of `query` is nearer to it."""
    q, t = _directions(query), _directions(train)
    out = np.full(len(q), -1, np.int32)
    owner = np.full(len(t), -1, np.int32)
    held = np.full(len(t), np.inf)
    x, y = t[:, 2].copy(), t[:, 3].copy()
    cost, sines = np.empty(len(t)), np.empty(len(t))
    for i in range(len(q)):
        best, dx, dy = -1, q[i, 2], q[i, 3]
        for j in range(len(t)):  # several at once
            cost[j], sines[j] = np.inf, abs(dx * y[j] - dy * x[j])
        for j in range(len(t)):
            sine = sines[j]
            if not sine <= sine_max:  # most pairs end here
                continue
            offset, overlap = _beside(q, i, t, j)
            if not (offset <= offset_px and overlap >= overlap_min):
                continue
            if mode == NONE:
                cost[j] = offset / max(offset_px, 1e-9) + sine / max(sine_max, 1e-9) + 1.0 - overlap
            else:
                cost[j] = float(_bits_apart(qwords, i, twords, j))
            if best < 0 or cost[j] < cost[best]:
                best = j
        if best < 0 or (mode != NONE and cost[best] > limit) or cost[best] >= held[best]:
            continue
        if ratio < 1.0 and _ambiguous(t, cost, best, ratio):
            continue
        if owner[best] >= 0:
            out[owner[best]] = -1
        owner[best], held[best], out[i] = i, cost[best], best
    return out


@kernel
def _ambiguous(t: F64, cost: F64, best: int, ratio: float) -> bool:
    """Whether another edge (not a collinear piece of the best one) is nearly as similar."""
    for j in range(len(t)):
        if j != best and cost[best] >= ratio * cost[j]:
            sine = abs(t[best, 2] * t[j, 3] - t[best, 3] * t[j, 2])
            beside = abs((t[j, 1] - t[best, 1]) * t[best, 2] - (t[j, 0] - t[best, 0]) * t[best, 3])
            if sine > 0.1 or beside > 2.0:
                return True
    return False


@kernel
def bits(a: U64, b: U64) -> F32:
    """(n, m) numbers of bits that differ."""
    out = np.empty((len(a), len(b)), np.float32)
    for i in range(len(a)):
        for j in range(len(b)):
            out[i, j] = hamming(a[i], b[j])
    return out
