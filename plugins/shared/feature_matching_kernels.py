"""Kernels of `feature_matching.py`: descriptor distances, matching of points and lines near a prediction, association of planes."""
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
def hamming(a: U64, i: int, b: U64, j: int) -> int:
    """Number of differing bits of row i of a and row j of b."""
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
    """Counting sort of points into a grid: (cols·rows + 1,) starts and the row numbers in cell order; points with NaN are skipped."""
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
                    distance = float(hamming(qwords, i, twords, t))
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
                cost[j] = float(hamming(qwords, i, twords, j))
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
    """Return True if another edge (not a collinear piece of the best one) is nearly as similar."""
    for j in range(len(t)):
        if j != best and cost[best] >= ratio * cost[j]:
            sine = abs(t[best, 2] * t[j, 3] - t[best, 3] * t[j, 2])
            beside = abs((t[j, 1] - t[best, 1]) * t[best, 2] - (t[j, 0] - t[best, 0]) * t[best, 3])
            if sine > 0.1 or beside > 2.0:
                return True
    return False


@kernel
def nearest_descriptors(query: U64, train: U64, max_bits: int, ratio: float) -> I32:
    """Match each of n descriptors (n, w) with the nearest (the first of equals) of m: its row (n,), or -1 where it is more than `max_bits` away, or
    not nearer than `ratio` × the second best (1 or more: no such test)."""
    out = np.full(len(query), -1, np.int32)
    for i in range(len(query)):
        best, second, row = 1 << 30, 1 << 30, -1
        for j in range(len(train)):
            distance = hamming(query, i, train, j)
            if distance < best:
                best, second, row = distance, best, j
            elif distance < second:
                second = distance
        if best <= max_bits and (ratio >= 1.0 or best < ratio * second):
            out[i] = row
    return out


@kernel
def hamming_distances(a: U64, b: U64) -> F32:
    """Hamming distances (n, m)."""
    out = np.empty((len(a), len(b)), np.float32)
    for i in range(len(a)):
        for j in range(len(b)):
            out[i, j] = hamming(a, i, b, j)
    return out


# Planes.


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
def associate_planes_kernel(a: F64, samples_a: F32, b: F64, samples_b: F32, cosine: float, limit: float, many_to_one: bool) -> I32:
    """Associate planes greedily by increasing cost; see `associate_planes`."""
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
def transform_plane_samples(planes: F64, samples_m: F32, R: F64, t: F64) -> tuple[F64, F32]:
    """Transform planes (p, 4) and points on them (p, s, 3) by the motion `p -> R p + t`."""
    coefficients, samples = np.empty((len(planes), 4)), np.empty((len(planes), samples_m.shape[1], 3), np.float32)
    for i in range(len(planes)):
        coefficients[i, 3] = planes[i, 3]
        for a in range(3):
            coefficients[i, a] = R[a, 0] * planes[i, 0] + R[a, 1] * planes[i, 1] + R[a, 2] * planes[i, 2]
            coefficients[i, 3] -= coefficients[i, a] * t[a]
            for k in range(samples_m.shape[1]):
                samples[i, k, a] = R[a, 0] * samples_m[i, k, 0] + R[a, 1] * samples_m[i, k, 1] + R[a, 2] * samples_m[i, k, 2] + t[a]
    return coefficients, samples
