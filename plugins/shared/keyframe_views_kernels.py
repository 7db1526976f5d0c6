"""Kernels of `keyframe_views.py`: novel readings, and the information gathered in voxels."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.voxel_hash_kernels import FREE, I64, key_of, slot_of


@kernel
def count_novel(keys: I64, numbers: I32, information: F64, points: F64, weight: F64, side: float, views: float) -> int:
    """Count the readings whose cell is unknown, or has less information than `views` times theirs."""
    novel = 0
    for i in range(len(points)):
        slot = slot_of(keys, key_of(int(np.floor(points[i, 0] / side)), int(np.floor(points[i, 1] / side)), int(np.floor(points[i, 2] / side))))
        if keys[slot] == FREE or information[numbers[slot]] < views * weight[i]:
            novel += 1
    return novel


@kernel
def add_readings(keys: I64, numbers: I32, gained: F64, points: F64, weight: F64, side: float, count: int) -> int:
    """Add new cells, and raise `gained` to the information of the readings in each cell; returns the number of cells."""
    for i in range(len(points)):
        key = key_of(int(np.floor(points[i, 0] / side)), int(np.floor(points[i, 1] / side)), int(np.floor(points[i, 2] / side)))
        slot = slot_of(keys, key)
        if keys[slot] == FREE:
            keys[slot], numbers[slot] = key, count
            count += 1
        gained[numbers[slot]] = max(gained[numbers[slot]], weight[i])
    return count
