"""Sets of ids by marking them."""

import numpy as np
import pytest

from trihedron.plugins.mapping.landmarks import distinct, isin, union


@pytest.mark.parametrize("a, b", [([5, 2, 9], [9, 1]), ([], [3]), ([3], []), ([], []), ([0], [0, 0])])
def test_they_are_those_of_numpy(a, b):
    a, b = np.array(a, np.int32), np.array(b, np.int32)
    assert np.array_equal(union(a, b), np.union1d(a, b)) and union(a, b).dtype == np.int32
    assert np.array_equal(isin(a, b), np.isin(a, b))
    assert np.array_equal(distinct(b), np.unique(b))
