"""Which of two regions beside each other are one plane."""

import numpy as np
import pytest

from trihedron.plugins.planes.common_kernels import merge_regions, neighbours


def sums(normal, d, left, right, sigma_m):
    """Normal equations (3, 3), (3,) and count of a region of exact cells between two image columns (x/z), with the weights of a sensor."""
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(left, right, 80), np.linspace(-0.3, 0.3, 100)))
    rays, q = np.stack([x, y, np.ones(len(x))], axis=1), -np.asarray(normal) / np.linalg.norm(normal) / d
    weight = 1.0 / (sigma_m * (rays @ q) ** 2) ** 2
    A = rays.T @ (rays * weight[:, None])
    return A, A @ q, len(x)


def merged(first, second, limit=0.3, alike=64.0):
    """Whether the second region becomes part of the first, which is the larger."""
    (A, b, n), (B, c, m) = first, second
    touch = np.array([[0.0, 9.0], [9.0, 0.0]])
    counts = np.array([n + 1, m], np.int32)
    owner = merge_regions(np.array([A, B]), np.array([b, c]), np.zeros((2, 4, 4)), counts, touch, limit, alike)
    return owner.tolist() == [0, 1, 1]


def test_halves_of_a_wall_are_one_plane_and_a_board_on_it_is_not():
    """A board 4 cm in front of a wall 3 m away, where σ of a depth is 2.6 cm: a plane through both fits each within half a σ, but leans."""
    normal = (0.3, 0.1, -1.0)
    wall = sums(normal, 2.9, -0.4, 0.0, 0.026)
    assert merged(wall, sums(normal, 2.9, 0.0, 0.4, 0.026))
    assert merged(wall, sums(normal, 2.904, 0.0, 0.4, 0.026))  # 4 mm: the sensor's error
    assert not merged(wall, sums(normal, 2.94, 0.0, 0.4, 0.026))
    assert merged(wall, sums((0.31, 0.1, -1.0), 2.9 + 0.003, 0.0, 0.4, 0.026))
    assert not merged(wall, sums((0.6, 0.1, -1.0), 2.9, 0.0, 0.4, 0.026))


@pytest.mark.parametrize(("gap", "expected"), [(1, 0.0), (2, 0.0), (3, 4.0)])
def test_regions_within_the_gap_touch(gap, expected):
    labels = np.zeros((4, 9), np.int32)
    labels[:, :3], labels[:, 5:] = 1, 2
    assert neighbours(labels, 2, gap).tolist() == [[0.0, expected], [expected, 0.0]]
