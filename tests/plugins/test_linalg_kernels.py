"""The order of many values against NumPy's stable sort."""

import numpy as np
import pytest

from trihedron.plugins.shared.linalg_kernels import descending, few_descending, median

RNG = np.random.default_rng(0)
VALUES = {
    "all sizes": RNG.normal(size=3000) * 10.0 ** RNG.integers(-300, 300, 3000),
    "many equals": np.rint(RNG.normal(size=3000) * 3.0),
    "zeros of both signs and infinities": np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, 0.0]),
    "one": np.array([3.0]),
    "none": np.zeros(0),
}


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES)
@pytest.mark.parametrize("ranked", (descending, few_descending))
def test_the_largest_comes_first_and_equals_keep_their_order(ranked, values):
    order = ranked(values)
    assert order.dtype == np.int32
    np.testing.assert_array_equal(order, np.argsort(-values, kind="stable"))


@pytest.mark.parametrize("count", (1, 2, 3, 10, 999, 1000))
@pytest.mark.parametrize("steps", (1e9, 3.0))  # all different; many equals
def test_the_median_is_numpys(count, steps):
    values = np.rint(steps * RNG.normal(size=count))
    assert median(values.copy()) == np.median(values)
