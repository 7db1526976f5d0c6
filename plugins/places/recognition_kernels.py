"""Numba kernels of `recognition.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.descriptors_kernels import U64, hamming
from trihedron.plugins.shared.linalg_kernels import polar_rotation


@kernel
def lookalikes_kernel(query: U64, train: U64, max_bits: int, ratio: float) -> I32:
    out = np.full(len(query), -1, np.int32)
    for i in range(len(query)):
        best, second, row = 1 << 30, 1 << 30, -1
        for j in range(len(train)):
            bits = hamming(query[i], train[j])
            if bits < best:
                best, second, row = bits, best, j
            elif bits < second:
                second = bits
        if best <= max_bits and (ratio >= 1.0 or best < ratio * second):
            out[i] = row
    return out


@kernel
def _as_long(camera_m: F64, world_m: F64, limit: F64, i: int, j: int) -> bool:
    """Whether two pairs of places are as far apart here as there, and far enough to tell a direction."""
    here, there = 0.0, 0.0
    for r in range(3):
        here += (camera_m[i, r] - camera_m[j, r]) ** 2
        there += (world_m[i, r] - world_m[j, r]) ** 2
    return here > 0.1**2 and abs(np.sqrt(here) - np.sqrt(there)) <= limit[i] + limit[j]


@kernel
def consensus(camera_m: F64, world_m: F64, limit: F64, draws: I32) -> tuple[F64, I32]:
    """Pose and number of agreeing pairs of each draw; 0 for one whose triangles differ."""
    poses, support = np.zeros((len(draws), 4, 4)), np.zeros(len(draws), np.int32)
    M, p, q, t = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(draws)):
        a, b, c = draws[k, 0], draws[k, 1], draws[k, 2]
        if a in (b, c) or b == c:
            continue
        if not (_as_long(camera_m, world_m, limit, a, b) and _as_long(camera_m, world_m, limit, b, c) and _as_long(camera_m, world_m, limit, c, a)):
            continue
        for r in range(3):
            p[r] = (camera_m[a, r] + camera_m[b, r] + camera_m[c, r]) / 3.0
            q[r] = (world_m[a, r] + world_m[b, r] + world_m[c, r]) / 3.0
        for r in range(3):
            for s in range(3):
                M[r, s] = 0.0
                for i in (a, b, c):
                    M[r, s] += (world_m[i, r] - q[r]) * (camera_m[i, s] - p[s])
        R = polar_rotation(M)
        for r in range(3):
            t[r] = q[r] - (R[r, 0] * p[0] + R[r, 1] * p[1] + R[r, 2] * p[2])
        for i in range(len(camera_m)):
            square = 0.0
            for r in range(3):
                e = R[r, 0] * camera_m[i, 0] + R[r, 1] * camera_m[i, 1] + R[r, 2] * camera_m[i, 2] + t[r] - world_m[i, r]
                square += e * e
            support[k] += square <= limit[i] * limit[i]
        for r in range(3):
            poses[k, r, 3] = t[r]
            for s in range(3):
                poses[k, r, s] = R[r, s]
        poses[k, 3, 3] = 1.0
    return poses, support
