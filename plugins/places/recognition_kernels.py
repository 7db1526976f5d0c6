"""Kernel of `recognition.py`: rigid poses from triples of point pairs, and their inliers."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32
from trihedron.plugins.shared.linalg_kernels import polar_rotation


@kernel
def _is_consistent(camera_m: F64, world_m: F64, limit: F64, i: int, j: int) -> bool:
    """Return True if two points have the same distance in the camera and in the world, and one that is long enough."""
    here, there = 0.0, 0.0
    for r in range(3):
        here += (camera_m[i, r] - camera_m[j, r]) ** 2
        there += (world_m[i, r] - world_m[j, r]) ** 2
    return here > 0.1**2 and abs(np.sqrt(here) - np.sqrt(there)) <= limit[i] + limit[j]


@kernel
def rigid_hypotheses_kernel(camera_m: F64, world_m: F64, limit: F64, samples: I32) -> tuple[F64, I32]:
    """Solve the pose of each sample and count its inliers; 0 for one whose triangles differ."""
    poses, inliers = np.zeros((len(samples), 4, 4)), np.zeros(len(samples), np.int32)
    M, p, q, t = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for k in range(len(samples)):
        a, b, c = samples[k, 0], samples[k, 1], samples[k, 2]
        if a in (b, c) or b == c:
            continue
        if not (
            _is_consistent(camera_m, world_m, limit, a, b)
            and _is_consistent(camera_m, world_m, limit, b, c)
            and _is_consistent(camera_m, world_m, limit, c, a)
        ):
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
            inliers[k] += square <= limit[i] * limit[i]
        for r in range(3):
            poses[k, r, 3] = t[r]
            for s in range(3):
                poses[k, r, s] = R[r, s]
        poses[k, 3, 3] = 1.0
    return poses, inliers
