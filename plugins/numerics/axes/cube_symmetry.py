"""The 24 rotations that map three orthogonal directions, signs apart, onto themselves."""

from __future__ import annotations

from itertools import permutations, product

import numba
import numpy as np

from trihedron.pipeline.core.types import F64


def _cube_rotations() -> F64:
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[order, range(3)] = signs
            if np.linalg.det(matrix) > 0.0:
                found.append(matrix)
    rotations = np.array(found)
    rotations.flags.writeable = False
    return rotations


CUBE = _cube_rotations()  # (24, 3, 3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def nearest_equivalent(R: F64, reference: F64) -> F64:
    """Of the 24 rotations `R @ S` with the same axes up to order and sign, the one nearest to `reference`; (3, 3) each."""
    best, highest, relative, out = 0, -4.0, np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                relative[i, j] += reference[k, i] * R[k, j]
    for n in range(24):
        trace = 0.0
        for i in range(3):
            for j in range(3):
                trace += relative[i, j] * CUBE[n, j, i]
        if trace > highest:
            best, highest = n, trace
    for i in range(3):
        for j in range(3):
            for k in range(3):
                out[i, j] += R[i, k] * CUBE[best, k, j]
    return out
