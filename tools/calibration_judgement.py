"""Judge a change of calibration by the half of a recording that it was not estimated from.

A recording is cut into blocks of consecutive frames. Each parameter is estimated from every other block and judged on the rest, then the other way
round. A block's gain is the relative decrease of its cost. A change is recommended when the mean gain of each half is positive, that of all blocks at
least LEAST_GAIN, and Student's t beyond the one-sided limit of SIGNIFICANCE.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

SIGNIFICANCE, LEAST_GAIN = 0.005, 0.01  # six changes are judged, so that 3 % of the recordings of a perfect camera have one by chance
BLOCKS, BLOCK_FRAMES = 12, 4  # at most; frames of a block, at least
Costs = Mapping[int, float]  # block -> cost, smaller is better


@dataclass(frozen=True)
class Judgement:
    """Mean relative gain on the blocks that were held out, its standard deviation, the number of blocks, and whether the change is recommended."""

    gain: float
    sigma: float
    blocks: int
    recommended: bool


def blocks_of(count: int) -> NDArray[np.int64]:
    """(count,) the block of each of `count` frames in order."""
    number = max(min(BLOCKS, count // BLOCK_FRAMES), 1)
    return np.arange(count) * number // max(count, 1)


def judge(costs: Callable[[int], tuple[Costs, Costs]]) -> Judgement:
    """Judge a change; `costs(half)` returns the costs of the blocks outside `half` (0 or 1: block number modulo 2) without the change, and with the
    parameters that half determines."""
    gains: list[float] = []
    means = []
    for half in (0, 1):
        before, after = costs(half)
        own = [(before[block] - after[block]) / max(abs(before[block]), 1e-12) for block in before]
        means.append(float(np.mean(own)) if own else 0.0)
        gains += own
    count = len(gains)
    if count < 4:
        return Judgement(0.0, float("inf"), count, False)
    mean, sigma = float(np.mean(gains)), float(np.std(gains, ddof=1) / np.sqrt(count))
    limit = float(student.isf(SIGNIFICANCE, count - 1))
    return Judgement(mean, sigma, count, mean > max(LEAST_GAIN, limit * sigma) and min(means) > 0.0)
