"""The order of many values against NumPy's stable sort."""

import numpy as np
import pytest

from trihedron.plugins.shared.sorting_kernels import descending

RNG = np.random.default_rng(0)
VALUES = {
    "all sizes": RNG.normal(size=3000) * 10.0 ** RNG.integers(-300, 300, 3000),
    "many equals": np.rint(RNG.normal(size=3000) * 3.0),
    "zeros of both signs and infinities": np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, 0.0]),
    "one": np.array([3.0]),
    "none": np.zeros(0),
}


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES)
def test_the_largest_comes_first_and_equals_keep_their_order(values):
    order = descending(values)
    assert order.dtype == np.int32
    np.testing.assert_array_equal(order, np.argsort(-values, kind="stable"))
