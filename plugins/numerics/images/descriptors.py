"""Matching of described points and lines near a predicted place, one to one.

Descriptors are compared only inside a gate (pixels, octave, direction), so that a wrong twin elsewhere in the image cannot be chosen.
Ties go to the lower row: the result does not depend on anything but the values.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.types import F32, F64, I32, U8
from trihedron.plugins.numerics.algebra.constant_arrays import constant

U64 = NDArray[np.uint64]
METRICS = ("hamming", "l2")
NONE, HAMMING, L2 = 0, 1, 2


def match_near(
    query_px: F32,
    query_descriptors: U8,
    query_octaves: U8,
    train_px: F32,
    train_descriptors: U8,
    train_octaves: U8,
    radius_px: F32,
    max_octave_step: int,
    max_distance: int,
    ratio: float,
    metric: str = "hamming",
) -> I32:
    """For each of n predicted points the row of the m found ones that looks like it, or -1.

    `query_px` (n, 2), `query_descriptors` (n, b), `query_octaves` (n,), `radius_px` (n,); `train_*` likewise with m rows. A candidate lies within the
    query's radius and `max_octave_step` octaves and is at most `max_distance` away (bits, or Euclidean for `metric` l2). The best must be nearer
    than `ratio` × the second best of its own octave (1 or more: no such test). A train row goes to its best query. Without descriptors (b == 0 or
    `max_distance` < 0) the nearest pixel is taken. NaN matches nothing. Raises ValueError for an unknown metric or unequal descriptors."""
    mode = compared_by(query_descriptors, train_descriptors, max_distance, metric)
    query, train = words_of(query_descriptors), words_of(train_descriptors)
    return near_matches(
        np.array(query_px, np.float32, order="C"), query[0], query[1], constant(query_octaves, np.uint8),
        constant(train_px, np.float32), train[0], train[1], constant(train_octaves, np.uint8),
        np.array(radius_px, np.float32, order="C"), int(max_octave_step), mode, float(max_distance), float(ratio),
    )  # fmt: skip


def match_lines(
    query_endpoints_px: F32,
    query_descriptors: U8,
    train_endpoints_px: F32,
    train_descriptors: U8,
    max_angle_deg: float,
    max_offset_px: float,
    min_overlap: float,
    max_distance: int,
    ratio: float,
) -> I32:
    """For each of n predicted image segments the row of the m found ones that is the same edge, or -1.

    End points (n, 2, 2), (m, 2, 2) as (start, end) × (x, y), in either order. A candidate's direction differs by at most `max_angle_deg`, it overlaps
    the query along its direction by `min_overlap` of the shorter of the two, and is at most `max_offset_px` beside it there; descriptors as in
    `match_near` (Hamming). The second best for `ratio` is the best one that is not a piece of the same edge as the best. Without descriptors
    (b == 0 or `max_distance` < 0) offset, angle and overlap decide. Raises ValueError for unequal descriptor lengths."""
    mode = compared_by(query_descriptors, train_descriptors, max_distance, "hamming")
    return line_matches(
        np.array(query_endpoints_px, np.float32, order="C"), words_of(query_descriptors)[0],
        constant(train_endpoints_px, np.float32), words_of(train_descriptors)[0],
        float(np.sin(np.radians(max_angle_deg))), float(max_offset_px), float(min_overlap), mode, float(max_distance), float(ratio),
    )  # fmt: skip


def compared_by(query: U8, train: U8, max_distance: int, metric: str) -> int:
    """How kernels compare these descriptors. Raises ValueError where they cannot."""
    if metric not in METRICS:
        raise ValueError(f"metric: '{metric}' is not one of {', '.join(METRICS)}")
    if len(query) and len(train) and query.shape[1] != train.shape[1]:
        raise ValueError(f"descriptors of {query.shape[1]} and {train.shape[1]} bytes cannot be compared")
    if query.shape[1] == 0 or max_distance < 0:
        return NONE
    return HAMMING if metric == "hamming" else L2


def words_of(descriptors: U8) -> tuple[U64, U8]:
    """(n, b) bytes as (n, ⌈b/8⌉) words, zero padded, and the bytes, as constants."""
    rows: Any = constant(descriptors, np.uint8)
    missing = -rows.shape[1] % 8
    padded = constant(np.pad(rows, ((0, 0), (0, missing))), np.uint8) if missing else rows
    return padded.view(np.uint64).reshape(len(rows), padded.shape[1] // 8), rows


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _ones(x: int) -> int:
    """Number of bits set in a word."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def hamming(a: U64, b: U64) -> int:
    """Number of differing bits of two rows of words."""
    total = np.uint64(0)
    for k in range(len(a)):
        total += _ones(a[k] ^ b[k])
    return int(total)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bits_apart(a: U64, i: int, b: U64, j: int) -> int:
    """`hamming` of row i of a and row j of b: for inner loops, where to slice them takes longer."""
    total = np.uint64(0)
    for k in range(a.shape[1]):
        total += _ones(a[i, k] ^ b[j, k])
    return int(total)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _euclidean(a: U8, i: int, b: U8, j: int) -> float:
    """Distance of row i of a and row j of b."""
    total = 0
    for k in range(a.shape[1]):
        step = int(a[i, k]) - int(b[j, k])
        total += step * step
    return float(np.sqrt(total))


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bounds(px: F32) -> tuple[float, float, float, float]:
    """Smallest and largest finite x, y; (0, 0, -1, -1) when there is none."""
    x0, y0, x1, y1 = np.inf, np.inf, -np.inf, -np.inf
    for i in range(len(px)):
        x, y = px[i, 0], px[i, 1]
        if np.isfinite(x) and np.isfinite(y):
            x0, y0, x1, y1 = min(x0, x), min(y0, y), max(x1, x), max(y1, y)
    return (x0, y0, x1, y1) if x1 >= x0 else (0.0, 0.0, -1.0, -1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _beside(q: F64, i: int, t: F64, j: int) -> tuple[float, float]:
    """Offset (px) beside row i of q in the middle of the overlap with row j of t, and overlap as a share of the shorter segment (negative: apart)."""
    mx, my, dx, dy, length = t[j, 0] - q[i, 0], t[j, 1] - q[i, 1], q[i, 2], q[i, 3], q[i, 4]
    along, beside = mx * dx + my * dy, my * dx - mx * dy
    cosine = dx * t[j, 2] + dy * t[j, 3]
    half = 0.5 * t[j, 4] * abs(cosine)
    low, high = max(along - half, -0.5 * length), min(along + half, 0.5 * length)
    slope = (dx * t[j, 3] - dy * t[j, 2]) / cosine if abs(cosine) > 1e-6 else 0.0
    return abs(beside + (0.5 * (low + high) - along) * slope), (high - low) / min(length, t[j, 4])


@numba.njit(cache=True, nogil=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _ambiguous(t: F64, cost: F64, best: int, ratio: float) -> bool:
    """Whether another edge (not a collinear piece of the best one) is nearly as similar."""
    for j in range(len(t)):
        if j != best and cost[best] >= ratio * cost[j]:
            sine = abs(t[best, 2] * t[j, 3] - t[best, 3] * t[j, 2])
            beside = abs((t[j, 1] - t[best, 1]) * t[best, 2] - (t[j, 0] - t[best, 0]) * t[best, 3])
            if sine > 0.1 or beside > 2.0:
                return True
    return False
