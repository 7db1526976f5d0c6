"""Statistics of an ablation: the Shapley value of each swap, and the NEES of a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations
from math import factorial
from typing import Any


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


def nees_of(metrics: Mapping[str, Any]) -> float | None:
    """Return the median NEES of the poses, 5.35 (χ² with six degrees of freedom) where covariances are right; None without ground truth."""
    found = metrics.get("consistency", {}).get("nees_median")
    return float(found) if found is not None else None
