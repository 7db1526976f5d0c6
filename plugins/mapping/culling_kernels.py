"""Numba kernels of `culling.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32, Bool

FARTHER = 1.2  # a landmark seen from at most this many times as far is seen as well: a level of the key points' pyramid


@kernel
def seen_as_near(
    observed: I32, ends: NDArray[np.int64], keyframes: I32, observers: I32, centres: F64, rows: I32, poses: F64, alive: Bool, others: int
) -> NDArray[np.int64]:
    """(2, n) how many landmarks each keyframe saw, and how many of them at least so many others that live saw from as near: `observed` those of each
    keyframe in turn up to its end, -1 what does not count, `observers` (m, OBSERVERS) and `centres` (m, 3) of the landmarks, `poses` (k, 4, 4) and
    `alive` (k,) of the keyframes `rows`, sorted, among which all observers are."""
    place, counts = np.empty(rows[-1] + 1, np.int32), np.zeros((2, len(keyframes)), np.int64)
    for k in range(len(rows)):
        place[rows[k]] = k
    counted, begin = np.full(len(centres), -1), 0  # the last keyframe that a landmark was counted for
    for k in range(len(keyframes)):
        for o in range(begin, ends[k]):
            i = observed[o]
            if i < 0 or counted[i] == k:
                continue
            counted[i] = k
            reach, count = FARTHER * _away(poses[place[keyframes[k]]], centres[i]), 0
            for row in observers[i]:
                if row >= 0 and row != keyframes[k] and alive[place[row]]:
                    count += _away(poses[place[row]], centres[i]) <= reach
            counts[0, k] += 1
            counts[1, k] += count >= others
        begin = ends[k]
    return counts


@kernel
def _away(T: F64, p: F64) -> float:
    """How far a point is from a camera."""
    x, y, z = T[0, 3] - p[0], T[1, 3] - p[1], T[2, 3] - p[2]
    return np.sqrt(x * x + y * y + z * z)
