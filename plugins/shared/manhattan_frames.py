"""The 24 rotations that map three orthogonal directions, signs apart, onto themselves."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.types import F64


def isotropic_information(directions: F64, sigma: F64) -> F64:
    """(n, 3) directions known to `sigma` (n,) rad every way."""
    return (np.eye(3) - directions[:, :, None] * directions[:, None, :]) / (sigma * sigma)[:, None, None]
