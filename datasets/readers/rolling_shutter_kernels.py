"""Kernels of `rolling_shutter.py`: where the pixels of one moment are in the image that was read, and one round of the fit of a rotation."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import solve_positive
from trihedron.pipeline.core.types import F32, F64

DAMPING = 1e-9  # of a rotation that few corners determine


@kernel
def pixels_read(start: F32, slope: F32, columns: F32) -> tuple[F32, F32, F32]:
    """Compute where the pixels (h, w) of one moment are in the image that was read: x, y and the factor of depth, from `row_lines` (h, 3) and the
    numbers (w,) of the columns."""
    h, w = len(start), len(columns)
    xs, ys, factors = np.empty((h, w), np.float32), np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    for r in range(h):
        x, y, z, dx, dy, dz = start[r, 0], start[r, 1], start[r, 2], slope[r, 0], slope[r, 1], slope[r, 2]
        row_x, row_y, row_z = xs[r], ys[r], factors[r]
        for c in range(w):
            factor = z + dz * columns[c]
            row_x[c], row_y[c], row_z[c] = (x + dx * columns[c]) / factor, (y + dy * columns[c]) / factor, factor
    return xs, ys, factors


@kernel
def fit_rotation(before: F64, after: F64, times: F64, weights: F64) -> tuple[F64, F64]:
    """Fit the rotation vector (3,) of a camera that moves image points (n, 2), in focal lengths, from `before` to `after`, by weighted least squares;
    also returns the distances (n,) that remain. `times` (n,) is the share of the rotation that acts on each point: the later it is read, the more."""
    A, b, turn, J, errors = np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.empty((2, 3)), np.empty(len(before))
    for i in range(len(before)):
        _flow_by_rotation(before, after, times, i, J)
        for k in range(2):
            flow = weights[i] * (after[i, k] - before[i, k])
            for m in range(3):
                b[m] += J[k, m] * flow
                for n in range(m + 1):
                    A[m, n] += weights[i] * J[k, m] * J[k, n]
    for m in range(3):
        A[m, m] += DAMPING
    solve_positive(A, b, turn)
    for i in range(len(before)):
        _flow_by_rotation(before, after, times, i, J)
        square = 0.0
        for k in range(2):
            square += (after[i, k] - before[i, k] - J[k, 0] * turn[0] - J[k, 1] * turn[1] - J[k, 2] * turn[2]) ** 2
        errors[i] = np.sqrt(square)
    return turn, errors


@kernel
def _flow_by_rotation(before: F64, after: F64, times: F64, i: int, J: F64) -> None:
    """Fill J (2, 3): the flow of point i, half way between its two places, by a rotation vector of the camera."""
    x, y, time = 0.5 * (before[i, 0] + after[i, 0]), 0.5 * (before[i, 1] + after[i, 1]), times[i]
    J[0, 0], J[0, 1], J[0, 2] = -x * y * time, (1.0 + x * x) * time, -y * time
    J[1, 0], J[1, 1], J[1, 2] = (-1.0 - y * y) * time, x * y * time, x * time
