"""Statistics of an ablation: Shapley values, paired differences with intervals, Holm's correction, effect sizes, and the number of repeats needed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import factorial

import numpy as np

from trihedron.tools.compare import CONFIDENCE, half_interval

POWER = 0.8  # probability with which the repeats needed would show the difference
MOST_REPEATS = 10_000


@dataclass(frozen=True)
class Paired:
    """Differences of one figure over pairs: mean, half the confidence interval and p-value by Student's t (None for a single pair), p after Holm's
    correction over all comparisons made, Cohen's d of paired samples, and the pairs needed to show a difference of this size."""

    figure: str
    pairs: int
    mean: float
    half: float | None = None
    p: float | None = None
    corrected: float | None = None
    effect: float | None = None
    needed: int | None = None

    @property
    def shown(self) -> bool:
        """True if the difference is statistically significant after the correction."""
        return self.corrected is not None and self.corrected < 1.0 - CONFIDENCE


def paired(figure: str, differences: Sequence[float]) -> Paired | None:
    """Return the statistics of finite paired differences, before the correction; None where there are none."""
    from scipy.stats import ttest_1samp

    values = np.array([value for value in differences if np.isfinite(value)])
    if not len(values):
        return None
    mean, spread = float(values.mean()), float(values.std(ddof=1)) if len(values) > 1 else 0.0
    if len(values) < 2:
        return Paired(figure, 1, mean)
    if spread <= 1e-12 * abs(mean) or spread == 0.0:  # equal in all pairs
        return Paired(figure, len(values), mean, 0.0, 0.0 if mean else 1.0, None, None, 2 if mean else None)
    effect = mean / spread
    return Paired(figure, len(values), mean, half_interval(values), float(ttest_1samp(values, 0.0).pvalue), None, effect, repeats_needed(effect))


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number (Holm, 1979): the smallest times n, the next times n - 1, and so on, never falling."""
    order, corrected, largest = np.argsort(p_values, kind="stable"), [0.0] * len(p_values), 0.0
    for rank, index in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        corrected[index] = largest
    return corrected


def repeats_needed(effect: float) -> int | None:
    """Return the number of pairs with which a two-sided paired t test would show an effect (Cohen's d) with a power of 80 %; None above 10 000."""
    low, high = 1, 2
    while not _power(effect, high) >= POWER:
        low, high = high, 2 * high
        if high > MOST_REPEATS:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if _power(effect, middle) >= POWER else (middle, high)
    return high


def _power(effect: float, pairs: int) -> float:
    """Power of the paired t test, by the non-central t distribution."""
    from scipy.stats import nct, t

    limit, shift = t.ppf(0.5 + 0.5 * CONFIDENCE, pairs - 1), abs(effect) * np.sqrt(pairs)
    upper = float(nct.sf(limit, pairs - 1, shift))
    return upper if np.isfinite(upper) else float(shift > limit)  # so far in the tail that the series fails


def shapley(values: Mapping[frozenset[str], float], players: Iterable[str]) -> dict[str, float]:
    """Return the Shapley value of each player (Shapley, 1953): the mean of what it adds, over all orders of joining. `values` has every subset of the
    players; the values of all players sum to values[all] - values[none]."""
    names = list(players)
    found = {}
    for name in names:
        others = [other for other in names if other != name]
        found[name] = sum(
            factorial(size) * factorial(len(others) - size) / factorial(len(names)) * (values[frozenset((*some, name))] - values[frozenset(some)])
            for size in range(len(names))
            for some in combinations(others, size)
        )
    return found
