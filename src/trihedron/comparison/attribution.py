"""Statistics of an ablation: the Shapley value of each swap, and the NEES of a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations
from math import factorial
from typing import Any


def shapley_weights(players: Iterable[str]) -> dict[str, dict[frozenset[str], float]]:
    """Return for each player the weight of the value of each subset of the players in its Shapley value (Shapley, 1953): the mean of what it adds,
    over all orders of joining. The values of all players sum to the value of all less that of none."""
    names = list(players)
    found: dict[str, dict[frozenset[str], float]] = {}
    for name in names:
        others = [other for other in names if other != name]
        weights = found.setdefault(name, {})
        for size in range(len(names)):
            weight = factorial(size) * factorial(len(others) - size) / factorial(len(names))
            for some in combinations(others, size):
                weights[frozenset(some)], weights[frozenset((*some, name))] = -weight, weight
    return found


def nees_of(metrics: Mapping[str, Any]) -> float | None:
    """Return the median NEES of the poses, 5.35 (χ² with six degrees of freedom) where covariances are right; None without ground truth."""
    found = metrics.get("consistency", {}).get("nees_median")
    return float(found) if found is not None else None
