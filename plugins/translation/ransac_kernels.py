"""Numba kernels of `ransac.py`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, Bool

MEANS = 3  # times the inliers' mean takes the place of the hypothesis


@kernel
def step_inliers(steps: F64, gates: F64, tried: NDArray[np.int64]) -> Bool:
    """Inlier mask (n,) of the steps (n, 3) of single points, one being an inlier within its own gate (n,), m: of the hypothesis with most inliers
    among the rows `tried`, then of the mean of its inliers, weighted by the square of their gates' inverse."""
    agree, most = np.zeros(len(steps), np.bool_), -1
    if len(steps) == 0:
        return agree
    centre = np.empty(3)
    for row in tried:
        count = 0
        for i in range(len(steps)):
            count += _within(steps[i], steps[row], gates[i])
        if count > most:
            most = count
            centre[:] = steps[row]
    for _ in range(1 + MEANS):
        total, mean = 0.0, np.zeros(3)
        for i in range(len(steps)):
            agree[i] = _within(steps[i], centre, gates[i])
            if agree[i]:
                weight = 1.0 / gates[i] ** 2
                total += weight
                for k in range(3):
                    mean[k] += weight * steps[i, k]
        if total == 0.0:
            break
        centre = mean / total
    return agree


@kernel
def _within(step: F64, centre: F64, gate: float) -> bool:
    squared: float = (step[0] - centre[0]) ** 2 + (step[1] - centre[1]) ** 2 + (step[2] - centre[2]) ** 2
    return squared < gate * gate
