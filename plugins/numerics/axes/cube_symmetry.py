"""The 24 rotations that map three orthogonal directions, signs apart, onto themselves."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from trihedron.pipeline.types import F64


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


def nearest_equivalent(R: F64, reference: F64) -> F64:
    """Of the 24 rotations `R @ S` with the same axes up to order and sign, the one nearest to `reference`; (3, 3) each."""
    return np.asarray(R @ CUBE[int(np.argmax(np.einsum("ij,nji->n", reference.T @ R, CUBE)))])
