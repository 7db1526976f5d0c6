"""How well planes and lines tell a direction: information (n, 3, 3) in 1/rad², zero along the direction itself."""

from __future__ import annotations

import numpy as np

from trihedron.pipeline.geometry import tangent_basis
from trihedron.pipeline.types import F32, F64


def plane_information(coefficients: F64, covariance: F64, floor: float) -> F64:
    """Of the normals of planes (n, 4) with `covariance` (n, 3, 3) of (a, b, d), see `types.Planes`; `floor` (rad) is added in square."""
    return _in_tangent_plane(coefficients[:, :3], covariance[:, :2, :2], floor)


def line_directions(endpoints_m: F32, covariance_m2: F32, floor: float) -> tuple[F64, F64, F64]:
    """Directions (n, 3), their information, and lengths (n,) of lines through end points (n, 2, 3) with covariances (n, 2, 3, 3); rows without a
    line have NaN directions."""
    along = (endpoints_m[:, 1] - endpoints_m[:, 0]).astype(np.float64)
    length = np.linalg.norm(along, axis=1)
    length[~(length > 1e-6)] = np.nan
    directions = along / length[:, None]
    basis = tangent_basis(directions)
    spread = (covariance_m2[:, 0] + covariance_m2[:, 1]).astype(np.float64) / (length * length)[:, None, None]
    return directions, _in_tangent_plane(directions, np.swapaxes(basis, 1, 2) @ spread @ basis, floor), length


def isotropic_information(directions: F64, sigma: F64) -> F64:
    """(n, 3) directions known to `sigma` (n,) rad every way."""
    return (np.eye(3) - directions[:, :, None] * directions[:, None, :]) / (sigma * sigma)[:, None, None]


def _in_tangent_plane(directions: F64, covariance: F64, floor: float) -> F64:
    """(n, 2, 2) covariance in `tangent_basis` -> information of the direction in 3D; zero where it is not finite."""
    a, b, d = covariance[:, 0, 0] + floor * floor, covariance[:, 0, 1], covariance[:, 1, 1] + floor * floor
    det = a * d - b * b
    inverse = np.stack([np.stack([d, -b], -1), np.stack([-b, a], -1)], -2) / np.where(det > 0.0, det, np.nan)[:, None, None]
    basis = tangent_basis(directions)
    out = basis @ inverse @ np.swapaxes(basis, 1, 2)
    return np.where(np.isfinite(out).all(axis=(1, 2), keepdims=True), out, 0.0)
