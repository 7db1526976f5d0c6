"""Kernel of `manhattan_prior.py`: rotations of keyframes from the directions of their landmarks."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.linalg_kernels import copy_matrix, dot, matmul, matvec, solve, split_pose
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
    S, axis, regular = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    for i in range(len(vectors)):
        along, nearest = matvec(R_world_manhattan.T, vectors[i]), 0
        for a in range(1, 3):
            if abs(along[a]) > abs(along[nearest]):
                nearest = a
        if not abs(along[nearest]) > least_cos:  # NaN too
            continue
        for a in range(3):
            axis[a] = R_world_manhattan[a, nearest] * np.sign(along[nearest])
        R, _ = split_pose(poses[keyframes[i]])
        e, r = matvec(R.T, axis), matvec(R.T, vectors[i])
        for a in range(3):
            r[a] -= e[a]
        S[0, 1], S[0, 2], S[1, 0], S[1, 2], S[2, 0], S[2, 1] = e[2], -e[1], -e[2], e[0], e[1], -e[0]  # phi × e = S phi
        A = matmul(matmul(R.T, information[i]), R)
        Ar = matvec(A, r)
        weight, SAS, SAr = 1.0 / (1.0 + dot(r, Ar) / gate**2), matmul(matmul(S.T, A), S), matvec(S.T, Ar)
        for a in range(3):
            g[keyframes[i], a] -= weight * SAr[a]
            for b in range(3):
                H[keyframes[i], a, b] += weight * SAS[a, b]
    for j in range(k):
        copy_matrix(H[j], regular)
        for a in range(3):
            regular[a, a] += 1e-2
        small = solve(regular, g[j])
        rotations[j, 0], rotations[j, 1], rotations[j, 2] = small[0], small[1], small[2]
    return rotations, H
