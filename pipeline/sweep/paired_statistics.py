"""Statistics of paired differences: intervals by Student's t, Holm's correction, power, and the number of repeats needed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import nctdtr, stdtr, stdtrit

CONFIDENCE = 0.95
LEVEL = 1.0 - CONFIDENCE
POWER = 0.8  # probability with which the repeats needed would show the difference
MOST_REPEATS = 10_000


def half_interval(values: Any) -> float | None:
    """Return half the width of the confidence interval of the mean of values (n,), by Student's t; None for fewer than two."""
    if len(values) < 2:
        return None
    return half_width(float(np.std(values, ddof=1)) / float(np.sqrt(len(values))), len(values) - 1)


def half_width(error: float, freedom: int) -> float:
    """Return half the width of the confidence interval of an estimate with this standard error and these degrees of freedom."""
    return float(stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE)) * error


def p_value(difference: float, error: float, freedom: int) -> float:
    """Return the two-sided p-value of no difference, by Student's t; of an error of 0: 1 for no difference, else 0."""
    if error == 0.0:
        return float(difference == 0.0)
    return float(2.0 * stdtr(freedom, -abs(difference) / error))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number (Holm, 1979): the smallest times n, the next times n - 1, and so on, never falling."""
    order, corrected, largest = np.argsort(p_values, kind="stable"), [0.0] * len(p_values), 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        corrected[index] = largest
    return corrected


def repeats_needed(effect: float, level: float = LEVEL) -> int | None:
    """Return the number of pairs with which a two-sided paired t test at this level would show an effect (Cohen's d) with a power of 80 %; None above
    10 000."""
    low, high = 1, 2
    while not power(effect * np.sqrt(high), high - 1, level) >= POWER:
        low, high = high, 2 * high
        if high > MOST_REPEATS:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if power(effect * np.sqrt(middle), middle - 1, level) >= POWER else (middle, high)
    return high


def power(shift: float, freedom: int, level: float = LEVEL) -> float:
    """Return the power of a two-sided t test, by the non-central t distribution; `shift` is the true difference by its standard error."""
    limit = float(stdtrit(freedom, 1.0 - 0.5 * level))
    upper = 1.0 - float(nctdtr(freedom, abs(shift), limit))
    return upper if np.isfinite(upper) else float(abs(shift) > limit)  # so far in the tail that the series fails
