"""Coordinates within a plane."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.geometry import tangent_basis
from trihedron.pipeline.core.linalg import det
from trihedron.pipeline.core.types import F64


def plane_axes(plane: F64) -> F64:
    """(3, 2) orthonormal columns in the plane (4,): with its normal they make a right-handed frame, so what is anticlockwise in them is so about
    n."""
    basis = tangent_basis(plane[:3])
    return basis if det(np.column_stack([basis, plane[:3]])) > 0.0 else np.ascontiguousarray(basis[:, ::-1])
