"""Arrays as kernels read them."""

from __future__ import annotations

from typing import Any

import numpy as np


def constant(array: Any, dtype: type[np.generic]) -> Any:
    """The array, contiguous and of an element type, as a view that cannot be written. To numba that is a type of its own, and the arrays of values
    have it: without this a kernel would be compiled anew for each mixture of them with computed ones, seconds later in the middle of a run."""
    view = np.ascontiguousarray(array, dtype).view()
    view.flags.writeable = False
    return view
