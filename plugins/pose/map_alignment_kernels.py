"""Kernels of `map_alignment.py`: the keyframes that the landmarks of a frame are from, and the surfaces that it observes."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32, U8
from trihedron.plugins.shared.calibration_error_kernels import Observers
from trihedron.plugins.shared.pose_optimizer_kernels import Groups


@kernel
def number_keyframes(count: int, created: Groups, observed: Observers) -> I32:
    """Replace rows of `count` keyframes by their numbers among the rows (k,) that occur, which are returned, increasing; -1 stays."""
    number = np.full(count, -1, np.int32)
    columns = (
        created.points, created.lines, created.planes, observed.points.reshape(-1), observed.lines.reshape(-1), observed.planes.reshape(-1)
    )  # fmt: skip
    for rows in columns:
        for i in range(len(rows)):
            if rows[i] >= 0:
                number[rows[i]] = 0
    out = np.flatnonzero(number == 0).astype(np.int32)
    for k in range(len(out)):
        number[out[k]] = k
    for rows in columns:
        for i in range(len(rows)):
            if rows[i] >= 0:
                rows[i] = number[rows[i]]
    return out


@kernel
def observed_surfaces(labels: U8, stride: int, coefficients: F64, pixels: F64) -> F64:
    """Return the planes (n, 4), of coefficients (p, 4), that are observed at pixels (n, 2), by the label image; NaN for none."""
    out = np.full((len(pixels), 4), np.nan)
    for i in range(len(pixels)):
        x, y = round(pixels[i, 0] / stride), round(pixels[i, 1] / stride)
        label = labels[min(max(y, 0), labels.shape[0] - 1), min(max(x, 0), labels.shape[1] - 1)]
        if label:
            for k in range(4):
                out[i, k] = coefficients[label - 1, k]
    return out
