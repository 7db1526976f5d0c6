"""Which of two regions beside each other are one plane."""

import numpy as np
import pytest

from trihedron.plugins.planes.region_merging_kernels import count_adjacent, merge_regions


def sums(normal, d, left, right, sigma_m, columns=80, rows=100, noise=None):
    """Normal equations (3, 3), (3,) and count of a region of cells between two image columns (x/z), with the weights of a sensor. They are exact, or
    have its noise: values (rows, columns) of a standard normal distribution."""
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(left, right, columns), np.linspace(-0.3, 0.3, rows)))
    rays, q = np.stack([x, y, np.ones(len(x))], axis=1), -np.asarray(normal) / np.linalg.norm(normal) / d
    weight = 1.0 / (sigma_m * (rays @ q) ** 2) ** 2
    inverse_depth = rays @ q + (0.0 if noise is None else noise.ravel() / np.sqrt(weight))
    return rays.T @ (rays * weight[:, None]), rays.T @ (weight * inverse_depth), len(x)


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


@pytest.mark.parametrize("lean", [0.0, 0.002, 0.004])
def test_a_step_is_one_although_noise_tilts_the_board(lean):
    """A board 3 cm in front of the wall and parallel to it within 0.2°: a plane through both fits each within 0.3 σ, but leans against both by
    more than they do against each other."""
    wall, board = sums((0.3, 0.1, -1.0), 2.9, -0.4, 0.0, 0.026), sums((0.3, 0.1 + lean, -1.0), 2.93, 0.0, 0.4, 0.026)
    assert not merged(wall, board)


def test_a_small_region_is_merged_in_spite_of_its_noise():
    """A stretch of wall of 16 by 16 cells, of which each 8 by 8 err as one: noise moves its plane by more than 0.3 σ, and 95 % are merged still."""
    rng, normal = np.random.default_rng(0), (0.3, 0.1, -1.0)
    wall = sums(normal, 2.9, -0.4, 0.0, 0.026)
    parts = [sums(normal, 2.9, 0.0, 0.1, 0.026, 16, 16, np.kron(rng.normal(size=(2, 2)), np.ones((8, 8)))) for _ in range(100)]
    assert sum(merged(wall, part) for part in parts) >= 95
    assert sum(merged(wall, part, alike=1.0) for part in parts) < 50  # where cells are taken to err one by one, the same noise is a step


@pytest.mark.parametrize(("gap", "expected"), [(1, 0.0), (2, 0.0), (3, 4.0)])
def test_regions_within_the_gap_touch(gap, expected):
    labels = np.zeros((4, 9), np.int32)
    labels[:, :3], labels[:, 5:] = 1, 2
    assert count_adjacent(labels, 2, gap).tolist() == [[0.0, expected], [expected, 0.0]]
