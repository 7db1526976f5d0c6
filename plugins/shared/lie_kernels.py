"""Kernels of the Lie groups SO(3): exponential (Rodrigues' formula), also applied from the left, and logarithm; and SE(3): adjoint; as in
`pipeline.core.lie`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import math

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64


@kernel(forceinline=True)
def rodrigues_coefficients(angle2: float) -> tuple[float, float]:
    """Return `sin(angle) / angle` and `(1 - cos(angle)) / angle²` for a squared angle."""
    if angle2 < 1e-12:
        return 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    angle = np.sqrt(angle2)
    return np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2


@kernel
def exp_so3(x: float, y: float, z: float) -> F64:
    """Map a rotation vector (x, y, z) to its rotation (3, 3)."""
    a, b = rodrigues_coefficients(x * x + y * y + z * z)
    E = np.empty((3, 3))
    E[0, 0], E[1, 1], E[2, 2] = 1.0 - b * (y * y + z * z), 1.0 - b * (x * x + z * z), 1.0 - b * (x * x + y * y)
    E[0, 1], E[0, 2], E[1, 2] = b * x * y - a * z, b * x * z + a * y, b * y * z - a * x
    E[1, 0], E[2, 0], E[2, 1] = b * x * y + a * z, b * x * z - a * y, b * y * z + a * x
    return E


@kernel
def left_multiply_exp(phi: F64, R: F64) -> None:
    """Rotate `R <- Exp(phi) R` in place, for the first three numbers of phi."""
    x, y, z = phi[0], phi[1], phi[2]
    a, b = rodrigues_coefficients(x * x + y * y + z * z)
    for c in range(3):
        u, v, w = R[0, c], R[1, c], R[2, c]
        p, q, r = y * w - z * v, z * u - x * w, x * v - y * u  # phi × column
        R[0, c] = u + a * p + b * (y * r - z * q)
        R[1, c] = v + a * q + b * (z * p - x * r)
        R[2, c] = w + a * r + b * (x * q - y * p)


@kernel
def log_so3(R: F64) -> tuple[float, float, float]:
    """Map a rotation (3, 3) by less than π to its rotation vector."""
    x, y, z = 0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])
    s, c = math.sqrt(x * x + y * y + z * z), 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    scale = math.atan2(s, c) / s if s > 1e-9 else 1.0
    return x * scale, y * scale, z * scale


@kernel
def log_so3_each(R: F64) -> F64:
    """Map rotations (n, 3, 3) by less than π to their rotation vectors (n, 3)."""
    out = np.empty((len(R), 3))
    for i in range(len(R)):
        out[i, 0], out[i, 1], out[i, 2] = log_so3(R[i])
    return out


@kernel(forceinline=True)
def rotation_between(R: F64, other: F64, out: F64) -> None:
    """Fill the upper left 3 × 3 of `out` with `Rᵀ · other`, of rotations or poses."""
    for i in range(3):
        for k in range(3):
            out[i, k] = R[0, i] * other[0, k] + R[1, i] * other[1, k] + R[2, i] * other[2, k]


@kernel
def adjoint_between(T: F64, other: F64, out: F64) -> None:
    """Fill the adjoint (6, 6) of `T⁻¹ · other`, two poses (4, 4): it takes xi of a camera at `other` to that of a camera at T that moves with it."""
    out[:] = 0.0
    t = np.empty(3)
    rotation_between(T, other, out)
    for i in range(3):
        t[i] = T[0, i] * (other[0, 3] - T[0, 3]) + T[1, i] * (other[1, 3] - T[1, 3]) + T[2, i] * (other[2, 3] - T[2, 3])
    for i, j, m in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for k in range(3):
            out[3 + i, 3 + k] = out[i, k]
            out[i, 3 + k] = t[j] * out[m, k] - t[m] * out[j, k]
