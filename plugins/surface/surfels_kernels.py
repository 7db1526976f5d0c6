"""Kernel of `surfels.py`: fusion of surfels of one place and direction."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.voxel_hash_kernels import I64, key_of, slot_of

CELL_M = 0.15  # surfels farther apart than this are never one


@kernel
def fuse_kernel(surfels: F64, out: F64, keys: I64, heads: I32, after: I32, count: int, cosine: float) -> int:
    """Fuse surfels (n, 13) into the first `count` rows of `out`, found by their cells, or append them; returns the new count."""
    before = count
    for i in range(len(surfels)):
        s = surfels[i]
        best, nearest = 1.0, -1
        x, y, z = int(np.floor(s[0] / CELL_M)), int(np.floor(s[1] / CELL_M)), int(np.floor(s[2] / CELL_M))
        for k in range(27):
            slot = slot_of(keys, key_of(x + k // 9 - 1, y + k // 3 % 3 - 1, z + k % 3 - 1))
            m = heads[slot] if keys[slot] >= 0 else -1
            while m >= 0:
                o = out[m]
                if m < before and s[3] * o[3] + s[4] * o[4] + s[5] * o[5] > cosine:
                    d = s[:3] - o[:3]
                    height = d[0] * o[3] + d[1] * o[4] + d[2] * o[5]
                    along = np.sqrt(max(dot(d, d) - height * height, 0.0))
                    limit = 3.0 / np.sqrt(s[10]) + 0.01
                    far = max(along / (0.7 * min(s[9], o[9])), abs(height) / limit)
                    if far < best:
                        best, nearest = far, m
                m = after[m]
        if nearest >= 0:
            o = out[nearest]
            share = s[10] / (s[10] + o[10])
            for k in range(9):
                o[k] += share * (s[k] - o[k])
            length = np.sqrt(o[3] ** 2 + o[4] ** 2 + o[5] ** 2)
            o[3:6] /= length
            o[9] = min(o[9], s[9])
            o[10] += s[10]
            o[12] += 1.0
        else:
            out[count] = s
            slot = slot_of(keys, key_of(x, y, z))
            if keys[slot] < 0:
                keys[slot], heads[slot] = key_of(x, y, z), -1
            after[count], heads[slot] = heads[slot], count
            count += 1
    return count
