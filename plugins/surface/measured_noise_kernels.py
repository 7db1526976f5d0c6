"""Kernel of `measured_noise.py`: distances of readings from their planes."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F32, F64, U8


@kernel
def off_planes(depth: F32, labels: U8, planes: F64, stride: int, step: int, intrinsics: F64) -> tuple[F64, F64]:
    """Distances of readings (n,) from their planes along their rays, and their depth."""
    h, w = labels.shape
    off, read, count = np.empty(h * w), np.empty(h * w), 0
    for r in range(0, h, step):
        for c in range(0, w, step):
            v, u = r * stride, c * stride
            if labels[r, c] == 0 or v >= depth.shape[0] or u >= depth.shape[1] or not depth[v, u] > 0.0:
                continue
            n = planes[labels[r, c] - 1]
            slope = n[0] * (u - intrinsics[2]) / intrinsics[0] + n[1] * (v - intrinsics[3]) / intrinsics[1] + n[2]
            if slope < 0.0:  # towards the camera
                off[count], read[count] = abs(depth[v, u] + n[3] / slope), depth[v, u]
                count += 1
    return off[:count], read[:count]
