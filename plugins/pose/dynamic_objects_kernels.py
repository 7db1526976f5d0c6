"""Kernels of `dynamic_objects.py`: features within matched planes, and a Mahalanobis distance."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import solve_positive
from trihedron.pipeline.core.types import F32, F64, I32, U8, Bool

ALONG = np.array([0.1, 0.3, 0.5, 0.7, 0.9], np.float32)  # parameters along a segment at which the label image is sampled


@kernel
def on_planes_kernel(labels: U8, planes: I32, stride: int, pixels: F32, points: I32, ends: F32, lines: I32) -> tuple[Bool, Bool]:
    """Masks of the matched points (n, 2) and lines (m, 2), rows of pixels (·, 2) and ends (·, 2, 2), that lie within matched planes (p, 2)."""
    known, flat, straight = np.zeros(256, np.bool_), np.zeros(len(points), np.bool_), np.ones(len(lines), np.bool_)
    for i in range(len(planes)):
        known[planes[i, 0] + 1] = True
    for i in range(len(points)):
        flat[i] = _inside(labels, known, stride, pixels[points[i, 0], 0], pixels[points[i, 0], 1])
    for i in range(len(lines)):
        row = lines[i, 0]
        for share in ALONG:
            rest = np.float32(1.0) - share
            x, y = rest * ends[row, 0, 0] + share * ends[row, 1, 0], rest * ends[row, 0, 1] + share * ends[row, 1, 1]
            straight[i] = straight[i] and _inside(labels, known, stride, x, y)
    return flat, straight


@kernel
def _inside(labels: U8, known: Bool, stride: int, u: float, v: float) -> bool:
    """Return True if all nine cells about a pixel have labels in the set `known` (256,)."""
    h, w = labels.shape
    x, y = round(u / stride), round(v / stride)
    for i in range(y - 1, y + 2):
        for j in range(x - 1, x + 2):
            if not known[labels[min(max(i, 0), h - 1), min(max(j, 0), w - 1)]]:
                return False
    return True


@kernel
def mahalanobis2(xi: F64, covariance: F64, count: int) -> float:
    """Squared Mahalanobis norm of the first `count` entries of xi (6,), by the leading block of its covariance (6, 6)."""
    S, x, total = np.empty((count, count)), np.empty(count), 0.0
    for i in range(count):
        for j in range(count):
            S[i, j] = covariance[i, j]
    solve_positive(S, xi[:count], x)
    for i in range(count):
        total += xi[i] * x[i]
    return total
