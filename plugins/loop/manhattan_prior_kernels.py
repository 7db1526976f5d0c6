"""Kernel of `manhattan_prior.py`: rotations of keyframes from the directions of their landmarks."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import dot, matmul, matvec, solve
from trihedron.pipeline.core.types import F64, I32


@kernel
def keyframe_rotations(
    vectors: F64, information: F64, keyframes: I32, R_world_manhattan: F64, poses: F64, least_cos: float, gate: float
) -> tuple[F64, F64]:
    """Estimate rotations (k, 3) and information (k, 3, 3), see `ManhattanPrior`, from world directions (n, 3) with their information, observed by the
    keyframes `keyframes` (n,).

    A direction v and its axis e, both in the camera: `v - Exp(-phi) e = v - e + phi × e` to first order; Cauchy's weights."""
    k = len(poses)
    H, g, rotations = np.zeros((k, 3, 3)), np.zeros((k, 3)), np.zeros((k, 3))
    S, A, e, r = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for i in range(len(vectors)):
        along = matvec(R_world_manhattan.T, vectors[i])
        axis = np.argmax(np.abs(along))
        if not abs(along[axis]) > least_cos:  # NaN too
            continue
        R = np.ascontiguousarray(poses[keyframes[i], :3, :3])
        e[:] = matvec(R.T, R_world_manhattan[:, axis] * np.sign(along[axis]))
        r[:] = matvec(R.T, vectors[i]) - e
        S[0, 1], S[0, 2], S[1, 0], S[1, 2], S[2, 0], S[2, 1] = e[2], -e[1], -e[2], e[0], e[1], -e[0]  # phi × e = S phi
        A[:] = matmul(matmul(R.T, information[i]), R)
        weight = 1.0 / (1.0 + dot(r, matvec(A, r)) / gate**2)
        H[keyframes[i]] += weight * matmul(matmul(S.T, A), S)
        g[keyframes[i]] -= weight * matvec(S.T, matvec(A, r))
    for j in range(k):
        rotations[j] = solve(H[j] + 1e-2 * np.eye(3), g[j])
    return rotations, H
