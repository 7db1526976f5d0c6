"""Numba kernels of `common_pose_graph.py`."""
# mypy: disable-error-code="arg-type, assignment, index, return-value"

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from trihedron.pipeline.core.kernel import kernel
from trihedron.pipeline.core.types import F64, I32

if TYPE_CHECKING:  # imported where it is needed: SciPy is slow to load, and most runs close no loop
    pass


@kernel
def turns_kernel(vectors: F64, information: F64, places: I32, R_world_manhattan: F64, poses: F64, least_cos: float, gate: float) -> tuple[F64, F64]:
    """(k, 3) and (k, 3, 3), see `Compass`, from world directions (n, 3) with their information, seen at the keyframes `places` (n,).

    A direction v and its axis e, both in the camera: `v - Exp(-phi) e = v - e + phi × e` to first order; Cauchy's weights."""
    k = len(poses)
    H, g, turns = np.zeros((k, 3, 3)), np.zeros((k, 3)), np.zeros((k, 3))
    S, A, e, r = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for i in range(len(vectors)):
        along = R_world_manhattan.T @ vectors[i]
        axis = np.argmax(np.abs(along))
        if not abs(along[axis]) > least_cos:  # NaN too
            continue
        R = np.ascontiguousarray(poses[places[i], :3, :3])
        e[:] = R.T @ (R_world_manhattan[:, axis] * np.sign(along[axis]))
        r[:] = R.T @ vectors[i] - e
        S[0, 1], S[0, 2], S[1, 0], S[1, 2], S[2, 0], S[2, 1] = e[2], -e[1], -e[2], e[0], e[1], -e[0]  # phi × e = S phi
        A[:] = R.T @ information[i] @ R
        weight = 1.0 / (1.0 + r @ A @ r / gate**2)
        H[places[i]] += weight * (S.T @ A @ S)
        g[places[i]] -= weight * (S.T @ (A @ r))
    for j in range(k):
        turns[j] = np.linalg.solve(H[j] + 1e-2 * np.eye(3), g[j])
    return turns, H
