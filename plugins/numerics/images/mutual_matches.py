"""Descriptors that are each other's nearest, wherever they are in the image."""

from __future__ import annotations

import numba
import numpy as np

from trihedron.pipeline.core.types import F32, I32, U8
from trihedron.plugins.numerics.images.descriptors import U64, hamming, words_of


def mutual_matches(before: U8, now: U8, metric: str, ratio: float) -> I32:
    """(k, 2) rows (before, now) of descriptors (n, b) and (m, b) that are nearest to each other, and whose second best is farther by 1/ratio. Of
    equals the first row is taken."""
    if len(before) < 2 or len(now) < 2:
        return np.zeros((0, 2), np.int32)
    near = _bits(words_of(before)[0], words_of(now)[0]) if metric == "hamming" else _lengths(before, now)
    forth, back = near.argmin(axis=1), near.argmin(axis=0)
    rows = np.flatnonzero(back[forth] == np.arange(len(before)))
    second = np.partition(near[rows], 1, axis=1)[:, 1]
    kept = rows[near[rows, forth[rows]] <= ratio * second]
    return np.stack([kept, forth[kept]], axis=1).astype(np.int32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bits(a: U64, b: U64) -> F32:
    """(n, m) numbers of bits that differ."""
    out = np.empty((len(a), len(b)), np.float32)
    for i in range(len(a)):
        for j in range(len(b)):
            out[i, j] = hamming(a[i], b[j])
    return out


def _lengths(a: U8, b: U8) -> F32:
    """(n, m) Euclidean distances."""
    x, y = a.astype(np.float32), b.astype(np.float32)
    return np.sqrt(np.maximum((x * x).sum(axis=1)[:, None] + (y * y).sum(axis=1) - 2.0 * x @ y.T, 0.0))
