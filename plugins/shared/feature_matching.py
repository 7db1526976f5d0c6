"""Feature matching: points and lines by descriptors near a predicted position or mutually nearest, planes by normal, distance and overlap.

Near a prediction, descriptors are compared only inside a gate (pixels, octave, direction), so that repeated structure elsewhere in the image cannot
be matched. Ties go to the lower row: the result depends on the values alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from trihedron.pipeline.core.kernel import constant
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import F32, F64, I32, U8
from trihedron.plugins.shared.feature_matching_kernels import (
    HAMMING,
    L2,
    NONE,
    U64,
    associate_planes_kernel,
    hamming_distances,
    line_matches,
    near_matches,
    nearest_descriptors,
)

METRICS = ("hamming", "l2")


def match_near(
    query_px: F32, query_descriptors: U8, query_octaves: U8, train_px: F32, train_descriptors: U8, train_octaves: U8,
    radius_px: F32, max_octave_step: int, max_distance: int, ratio: float, metric: str = "hamming",
) -> I32:  # fmt: skip
    """Match each of n predicted points with the most similar of m detected ones: its row (n,), or -1.

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
    query_endpoints_px: F32, query_descriptors: U8, train_endpoints_px: F32, train_descriptors: U8,
    max_angle_deg: float, max_offset_px: float, min_overlap: float, max_distance: int, ratio: float,
) -> I32:  # fmt: skip
    """Match each of n predicted image segments with the same edge among m detected ones: its row (n,), or -1.

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


def nearest_matches(query: U8, train: U8, max_bits: int, ratio: float) -> I32:
    """Match each of n binary descriptors (n, bytes) with the nearest of m, anywhere: its row (n,), or -1; see `nearest_descriptors`."""
    return nearest_descriptors(words_of(query)[0], words_of(train)[0], max_bits, ratio)


def compared_by(query: U8, train: U8, max_distance: int, metric: str) -> int:
    """Return how kernels compare these descriptors: NONE, HAMMING or L2. Raises ValueError where they cannot."""
    if metric not in METRICS:
        raise ValueError(f"metric: '{metric}' is not one of {', '.join(METRICS)}")
    if len(query) and len(train) and query.shape[1] != train.shape[1]:
        raise ValueError(f"descriptors of {query.shape[1]} and {train.shape[1]} bytes cannot be compared")
    if query.shape[1] == 0 or max_distance < 0:
        return NONE
    return HAMMING if metric == "hamming" else L2


def words_of(descriptors: U8) -> tuple[U64, U8]:
    """View descriptors of (n, b) bytes as (n, ⌈b/8⌉) words, zero padded; also returns the bytes, both read-only."""
    rows: Any = constant(descriptors, np.uint8)
    missing = -rows.shape[1] % 8
    padded = constant(np.pad(rows, ((0, 0), (0, missing))), np.uint8) if missing else rows
    return padded.view(np.uint64).reshape(len(rows), padded.shape[1] // 8), rows


def mutual_matches(before: U8, now: U8, metric: str, ratio: float) -> I32:
    """Match descriptors (n, b) and (m, b) that are mutually nearest, anywhere in the image, and whose second best is farther by 1/ratio: rows (k, 2).
    Of equals the first row is taken."""
    if len(before) < 2 or len(now) < 2:
        return np.zeros((0, 2), np.int32)
    near = hamming_distances(words_of(before)[0], words_of(now)[0]) if metric == "hamming" else _euclidean_distances(before, now)
    forth, back = near.argmin(axis=1), near.argmin(axis=0)
    rows = np.flatnonzero(back[forth] == np.arange(len(before)))
    second = np.partition(near[rows], 1, axis=1)[:, 1]
    kept = rows[near[rows, forth[rows]] <= ratio * second]
    return np.stack([kept, forth[kept]], axis=1).astype(np.int32)


def _euclidean_distances(a: U8, b: U8) -> F32:
    """Euclidean distances (n, m)."""
    x, y = a.astype(np.float32), b.astype(np.float32)
    return np.asarray(np.sqrt(np.maximum((x * x).sum(axis=1)[:, None] + (y * y).sum(axis=1) - matmul(2.0 * x, y.T), 0.0)))


# Planes.


def associate_planes(
    coefficients_a: F64, samples_a: F32, coefficients_b: F64, samples_b: F32, max_angle_deg: float, max_distance_m: float, many_to_one: bool = False
) -> I32:
    """Pair (row of a, row of b), (p, 2) sorted by a, the planes that are the same, observed from the same side (section III-A).

    `coefficients_*` (n, 4), (m, 4) and `samples_*` (n, s, 3), (m, r, 3; NaN padded) are all in one frame, metres. A pair passes when its normals
    differ by at most `max_angle_deg` (opposite normals are the two faces of a thin wall: no pair) and the *mean* distance of the samples of one
    region to the other plane, the better-conditioned way round, is at most `max_distance_m`; the minimum over points would merge parallel
    planes that touch anywhere. Among those the one with the smallest `distance / max_distance_m + 1 - overlap` wins, overlap being the share of
    a's samples near samples of b. A row of a appears once; a row of b too, unless `many_to_one` (a wall seen in two pieces)."""
    return associate_planes_kernel(
        constant(coefficients_a, np.float64), constant(samples_a, np.float32),
        np.array(coefficients_b, np.float64, order="C"), np.array(samples_b, np.float32, order="C"),
        float(np.cos(np.radians(max_angle_deg))), float(max_distance_m), many_to_one,
    )  # fmt: skip
