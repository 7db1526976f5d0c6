"""A building made by hand, of two rooms."""

import numpy as np

from trihedron.pipeline.core.types import Building


def two_rooms() -> Building:
    """Two rooms of 4 by 3 m on either side of a wall with a door, which is 10 cm thick; walls 1 to 6 are round them."""
    T = np.eye(4)
    left, right = [[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]], [[4.1, 0.0], [8.1, 0.0], [8.1, 3.0], [4.1, 3.0]]
    around = [(left[0], left[1]), (left[2], left[3]), (left[3], left[0]), (right[0], right[1]), (right[1], right[2]), (right[2], right[3])]
    walls = np.array([(left[1], left[2]), *around])
    corner_walls = np.array([1, 0, 2, 3, 4, 5, 6, 0], np.int32)
    support = np.array([(1, k, 2, k) for k in range(7)] + [(2, 0, 2, 9), (3, 0, 2, 8)], np.int32)
    return Building(
        5, 7, T, "", np.array([[0.0, 2.5]]), np.full((1, 2, 2), 1e-4), walls, np.zeros(7, np.int32), np.array([0.1, *[np.nan] * 6]),
        np.tile(np.eye(3) * 1e-4, (7, 1, 1)), np.array([[2.0, 0.5, 1.0]]), np.zeros(2, np.int32), np.array([[0, 0, 4], [1, 4, 8]], np.int32),
        np.array(left + right), corner_walls, np.full(8, 0.01), np.array([12.0, 12.0]), np.full(2, 1e-4), np.ones(2, np.bool_),
        np.zeros(1, np.int32), np.zeros(1, np.uint8), np.array([[1.0, 1.9]]), np.array([[0.0, 2.1]]), np.tile(np.eye(4) * 1e-4, (1, 1, 1)),
        np.array([[0, 1]], np.int32), np.empty(0, np.int32), support, np.empty((0, 3)),
    )  # fmt: skip
