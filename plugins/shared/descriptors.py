"""Matching of described points and lines near a predicted place, one to one.

Descriptors are compared only inside a gate (pixels, octave, direction), so that a wrong twin elsewhere in the image cannot be chosen.
Ties go to the lower row: the result does not depend on anything but the values.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from trihedron.pipeline.core.types import F32, I32, U8
from trihedron.plugins.shared.descriptors_kernels import HAMMING, L2, NONE, U64, bits, line_matches, near_matches
from trihedron.plugins.shared.linalg import constant

METRICS = ("hamming", "l2")


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


# Descriptors that are each other's nearest, wherever they are in the image.


def mutual_matches(before: U8, now: U8, metric: str, ratio: float) -> I32:
    """(k, 2) rows (before, now) of descriptors (n, b) and (m, b) that are nearest to each other, and whose second best is farther by 1/ratio. Of
    equals the first row is taken."""
    if len(before) < 2 or len(now) < 2:
        return np.zeros((0, 2), np.int32)
    near = bits(words_of(before)[0], words_of(now)[0]) if metric == "hamming" else _lengths(before, now)
    forth, back = near.argmin(axis=1), near.argmin(axis=0)
    rows = np.flatnonzero(back[forth] == np.arange(len(before)))
    second = np.partition(near[rows], 1, axis=1)[:, 1]
    kept = rows[near[rows, forth[rows]] <= ratio * second]
    return np.stack([kept, forth[kept]], axis=1).astype(np.int32)


def _lengths(a: U8, b: U8) -> F32:
    """(n, m) Euclidean distances."""
    x, y = a.astype(np.float32), b.astype(np.float32)
    return np.sqrt(np.maximum((x * x).sum(axis=1)[:, None] + (y * y).sum(axis=1) - 2.0 * x @ y.T, 0.0))
