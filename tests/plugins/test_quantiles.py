"""Quantiles are those of NumPy."""

import numpy as np
import pytest

from trihedron.plugins.shared.quantiles import quantiles

SHARES = [0.0, 0.1, 0.25, 0.5, 0.9, 1.0]


@pytest.mark.parametrize("count", [1, 2, 3, 50, 333])
def test_quantiles_lie_between_neighbours(count):
    values = np.random.default_rng(count).normal(size=count)
    assert quantiles(values, SHARES) == pytest.approx(np.quantile(values, SHARES), rel=1e-14, abs=1e-15)
    assert float(quantiles(values, 0.25)) == pytest.approx(np.quantile(values, 0.25), rel=1e-14, abs=1e-15)
