"""Numba kernels of `keyframe_views.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.voxel_hash_kernels import FREE, I64, key_of, slot_of


@kernel
def news(keys: I64, numbers: I32, information: F64, points: F64, weight: F64, side: float, views: float) -> int:
    fresh = 0
    for i in range(len(points)):
        slot = slot_of(keys, key_of(int(np.floor(points[i, 0] / side)), int(np.floor(points[i, 1] / side)), int(np.floor(points[i, 2] / side))))
        if keys[slot] == FREE or information[numbers[slot]] < views * weight[i]:
            fresh += 1
    return fresh


@kernel
def learn(keys: I64, numbers: I32, gained: F64, points: F64, weight: F64, side: float, count: int) -> int:
    for i in range(len(points)):
        key = key_of(int(np.floor(points[i, 0] / side)), int(np.floor(points[i, 1] / side)), int(np.floor(points[i, 2] / side)))
        slot = slot_of(keys, key)
        if keys[slot] == FREE:
            keys[slot], numbers[slot] = key, count
            count += 1
        gained[numbers[slot]] = max(gained[numbers[slot]], weight[i])
    return count
