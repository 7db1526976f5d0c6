"""Branch and bound over all rotations: what it finds against brute force, and every bound it rests on against samples."""

from itertools import pairwise

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import nearest_rotation
from trihedron.pipeline.core.lie import exp_so3, log_so3, rotation_angle_deg
from trihedron.plugins.manhattan import branch_and_bound, branch_and_bound_kernels
from trihedron.plugins.manhattan.branch_and_bound import FACE, BranchAndBound, RotationSearch, sphere_grid
from trihedron.plugins.manhattan.branch_and_bound_kernels import (
    angle_to_equivalent,
    cell_of,
    climb,
    coarser,
    consensus_bound,
    cube_radius,
    curvature,
    group_directions,
    largest_near,
    neighbours,
    summit_radius,
)
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE, nearest_equivalent

INLIER = np.radians(12.0)


def search_with(max_gap=0.0, max_cubes=200_000):
    return RotationSearch(BranchAndBound(inlier_deg=12.0, certificate_deg=1.0, max_gap=max_gap, max_cubes=max_cubes))


SEARCH = search_with()


def consensus(vectors, weights, rotations):
    """C of each of (m, 3, 3) rotations, from the definition."""
    cosine = np.abs(np.einsum("ni,mik->mnk", vectors, np.reshape(rotations, (-1, 3, 3)))).max(axis=2)
    return np.maximum(1.0 - (1.0 - cosine**2) / np.sin(INLIER) ** 2, 0.0) @ weights


def brute_force(vectors, weights, R, step_deg=4.0, refined=30):
    """The greatest consensus on a grid over all rotations, and after refining its best points: on the inliers the orthogonal Procrustes problem."""
    ticks = np.radians(np.arange(-45.0, 45.1, step_deg))
    v = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    angle = np.linalg.norm(v, axis=1)[:, None, None] + 1e-12
    K = np.zeros((len(v), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    K -= np.swapaxes(K, 1, 2)
    grid = R @ (np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / angle**2 * (K @ K))
    values = np.concatenate([consensus(vectors, weights, part) for part in np.array_split(grid, 40)])
    best, top = -1.0, np.eye(3)
    for R in grid[np.argsort(-values)[:refined]]:
        for _ in range(30):
            dots = vectors @ R
            axis = np.abs(dots).argmax(axis=1)
            dot = dots[np.arange(len(dots)), axis]
            pull = (weights * dot * (np.abs(dot) > np.cos(INLIER)))[:, None] * vectors
            R = nearest_rotation(np.stack([pull[axis == k].sum(axis=0) for k in range(3)], axis=1) + 1e-9 * R)
        value = consensus(vectors, weights, R)[0]
        best, top = (value, R) if value > best else (best, top)
    return best, top, values.max()


def walls(directions, rng, shares, noise_deg=3.0, count=300):
    """Directions on axes of a random R by `shares`, the rest of them any way, with random weights: (R, vectors, weights)."""
    R = directions.rotation(rng)
    numbers = [int(share * count) for share in shares]
    on_axes = directions.tilted(rng, np.repeat(R.T[: len(shares)], numbers, axis=0), noise_deg) if sum(numbers) else np.zeros((0, 3))
    vectors = np.concatenate([on_axes, directions.spherical(rng, count - sum(numbers))])
    return R, vectors, rng.uniform(0.5, 2.0, count)


CASES = [
    ((0.3, 0.3, 0.3), 3.0),
    ((0.5, 0.1, 0.1), 3.0),
    ((0.25, 0.25), 3.0),
    ((0.8, 0.05), 2.0),
    ((0.3, 0.3, 0.3), 8.0),
    ((0.1, 0.1, 0.1), 4.0),
    ((), 0.0),
]  # shares of the axes, noise


@pytest.mark.parametrize("shares,noise_deg", [CASES[0], *(pytest.param(*case, marks=pytest.mark.slow) for case in CASES[1:])])
def test_the_optimum_is_that_of_brute_force(directions, shares, noise_deg):
    rng = np.random.default_rng(1)
    for _ in range(3):
        _, vectors, weights = walls(directions, rng, shares, noise_deg)
        found = SEARCH(vectors, weights, directions.rotation(rng))
        best, top, on_grid = brute_force(vectors, weights, directions.rotation(rng))
        assert found.open == 0 and on_grid <= best
        assert found.consensus >= best * (1.0 - 1e-9) and found.upper >= best
        reached = consensus(vectors, weights, found.R)[0]
        assert np.isclose(found.consensus, reached) and np.isclose(SEARCH.consensus(vectors, weights, found.R), reached)
        assert found.consensus > best * (1.0 + 1e-9) or np.degrees(angle_to_equivalent(found.R, top)) < 0.01
        assert found.upper < 1.03 * found.consensus


def test_of_two_frames_the_better_wherever_it_starts(directions):
    """Two Manhattan frames 30° apart, one with 4 % more: a local method stays in the one it starts in."""
    rng = np.random.default_rng(2)
    for _ in range(10):
        R = directions.rotation(rng)
        other = R @ exp_so3(np.radians(30.0) * np.full(3, 1.0 / np.sqrt(3.0)))
        vectors = directions.tilted(rng, np.concatenate([np.repeat(R.T, 104, axis=0), np.repeat(other.T, 100, axis=0)]), 2.0)
        weights = np.ones(len(vectors))
        groups = group_directions(vectors, weights)
        lesser, value = climb(groups, other, INLIER, 30)
        found = SEARCH(vectors, weights, other)
        assert found.open == 0 and found.consensus > value and np.degrees(angle_to_equivalent(found.R, R)) < 1.0
        assert np.degrees(angle_to_equivalent(lesser, other)) < 3.0


def test_nothing_beyond_the_certificate_is_better(directions):
    rng = np.random.default_rng(3)
    for _ in range(5):
        _, vectors, weights = walls(directions, rng, (0.4, 0.1, 0.05))
        found = SEARCH(vectors, weights, np.eye(3))
        for size in (1.0, 2.0, 5.0, 20.0):
            turns = [exp_so3(np.radians(size * rng.uniform(1.0, 1.5)) * axis) @ found.R for axis in directions.spherical(rng, 200)]
            assert consensus(vectors, weights, turns).max() < found.consensus


def test_a_work_limit_leaves_a_gap_that_is_true(directions):
    rng = np.random.default_rng(4)
    _, vectors, weights = walls(directions, rng, (0.3, 0.1), 6.0)
    start = directions.rotation(rng)
    best, gaps = brute_force(vectors, weights, np.eye(3))[0], []
    for limit in (1, 600, 1500, 200_000):
        found = search_with(max_cubes=limit)(vectors, weights, start)
        gaps.append(found.upper / found.consensus - 1.0)
        assert found.upper >= best and found.cubes <= max(limit, 512) and (found.open == 0) == (limit == 200_000)
    assert gaps[0] >= gaps[1] >= gaps[2] > gaps[3] and gaps[3] < 0.02 < gaps[0]


def test_slack_saves_work_and_is_told(directions):
    rng = np.random.default_rng(5)
    _, vectors, weights = walls(directions, rng, (0.9,))
    strict, loose = (search_with(slack)(vectors, weights, np.eye(3)) for slack in (0.0, 0.01))
    assert loose.cubes < 0.5 * strict.cubes and strict.consensus <= loose.upper <= loose.consensus * 1.0101


def test_every_rotation_has_an_equivalent_in_the_first_cube(directions):
    rng = np.random.default_rng(6)
    R_start = directions.rotation(rng)
    furthest = max(min(np.abs(log_so3(R_start.T @ R @ S)).max() for S in CUBE) for R in (directions.rotation(rng) for _ in range(1500)))
    assert np.degrees(furthest) <= 45.0
    assert np.abs(branch_and_bound_kernels._first_cubes()).max() + branch_and_bound.HALF_WIDTH / branch_and_bound.FIRST == pytest.approx(np.pi / 4.0)
    R = np.empty((3, 3))
    v = np.array([0.3, -0.2, 0.5])
    branch_and_bound_kernels._centre(v, R_start, R)
    assert np.allclose(R, R_start @ exp_so3(v))


@pytest.mark.parametrize("half_deg", [45.0 / 8, 1.0, 0.05])
def test_every_rotation_of_a_cube_is_within_its_radius(half_deg):
    """Corners and random places of cubes all over the search; a corner of the cube about the identity is at that radius."""
    rng, half = np.random.default_rng(12), np.radians(half_deg)
    corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for centre in np.concatenate([np.zeros((1, 3)), rng.uniform(-1.0, 1.0, (20, 3)) * (np.pi / 4.0 - half)]):
        vectors = centre + np.concatenate([corners, rng.uniform(-half, half, (30, 3))])
        angles = [np.linalg.norm(log_so3(exp_so3(centre).T @ exp_so3(v))) for v in vectors]
        assert max(angles) <= cube_radius(half) * (1.0 + 1e-7)
        assert centre.any() or max(angles) == pytest.approx(cube_radius(half), rel=1e-6)


def test_angle_to_the_nearest_equivalent(directions):
    rng = np.random.default_rng(7)
    for _ in range(300):
        R, Q = directions.rotation(rng), directions.rotation(rng)
        truth = rotation_angle_deg(R.T @ nearest_equivalent(Q, R))
        angle = np.degrees(angle_to_equivalent(R, Q))
        assert np.isclose(angle, truth, atol=1e-5) if angle < 45.0 else truth >= 45.0 - 1e-9


@pytest.mark.parametrize("radius_deg", [0.1, 1.0, 2.5, 9.0, 15.0])
def test_bound_holds_within_the_ball(directions, radius_deg):
    rng = np.random.default_rng(8)
    for _ in range(12):
        R, vectors, weights = walls(directions, rng, (0.3, 0.2, 0.1), rng.uniform(1.0, 8.0))
        centre = R @ exp_so3(np.radians(rng.uniform(0.0, 12.0)) * directions.spherical(rng, 1)[0])
        value, upper = consensus_bound(group_directions(vectors, weights), centre, np.radians(radius_deg), INLIER)
        turns = [exp_so3(np.radians(radius_deg) * share * axis) @ centre for share in (0.5, 1.0) for axis in directions.spherical(rng, 100)]
        assert np.isclose(value, consensus(vectors, weights, centre)[0]) and consensus(vectors, weights, turns).max() <= upper


def test_bound_closes_faster_than_the_ball(directions):
    """The excess at a summit falls with the square of the radius, and far below what enlarging every cone by the radius would give."""
    rng = np.random.default_rng(9)
    _, vectors, weights = walls(directions, rng, (0.3, 0.3, 0.3), count=2000)
    top = SEARCH(vectors, weights, np.eye(3)).R
    groups = group_directions(vectors, weights)
    value = consensus_bound(groups, top, 0.0, INLIER)[0]
    excess = [consensus_bound(groups, top, np.radians(r), INLIER)[1] / value - 1.0 for r in (0.5, 1.0, 2.0)]
    assert excess[0] < 0.001 and 2.5 < excess[1] / excess[0] < 6.0 and 2.5 < excess[2] / excess[1] < 10.0
    off = np.arccos(np.clip(np.abs(vectors @ top).max(axis=1), 0.0, 1.0))
    enlarged = weights @ np.maximum(1.0 - np.sin(np.maximum(off - np.radians(1.0), 0.0)) ** 2 / np.sin(INLIER) ** 2, 0.0)
    assert excess[1] < 0.05 * (enlarged / value - 1.0)


def test_nothing_on_the_flanks_of_a_summit_is_higher(directions):
    rng, reached = np.random.default_rng(10), []
    for _ in range(8):
        _, vectors, weights = walls(directions, rng, (0.3, 0.2, 0.2), 3.0, 800)
        groups = group_directions(vectors, weights)
        found = SEARCH(vectors, weights, np.eye(3))
        reach = summit_radius(groups, found.R, found.consensus, np.radians(1.0), INLIER)
        reached.append(np.degrees(reach))
        angles = rng.uniform(np.radians(1.0), max(reach, np.radians(1.0)), 400)
        turns = [exp_so3(angle * axis) @ found.R for angle, axis in zip(angles, directions.spherical(rng, 400))]
        assert consensus(vectors, weights, turns).max() <= found.consensus
        assert summit_radius(groups, found.R @ exp_so3(np.array([0.05, 0.0, 0.0])), found.consensus * 0.95, np.radians(1.0), INLIER) < np.radians(1.1)
    assert np.median(reached) > 3.0


def derivatives(d, r, axis, h=2e-3):
    """Second and third derivative of (d·r)² by the angle of a rotation of r about the axis, at 0."""
    values = [(d @ exp_so3(k * h * axis) @ r) ** 2 for k in (-2, -1, 0, 1, 2)]
    return np.dot([-1, 16, -30, 16, -1], values) / (12.0 * h**2), np.dot([-1, 2, 0, -2, 1], values) / (2.0 * h**3)


def test_derivatives_are_bounded_and_the_bounds_attained(directions):
    rng = np.random.default_rng(11)
    for _ in range(1000):
        r, axis = directions.spherical(rng, 2)
        across = np.cross(r, directions.spherical(rng, 1)[0])
        across /= np.linalg.norm(across)
        beta = rng.uniform(0.0, np.radians(44.0))
        d = exp_so3(beta * across) @ r
        second, third = derivatives(d, r, axis)
        assert second <= curvature(beta) + 1e-6 and abs(third) <= 4.0
        assert np.isclose(derivatives(d, r, exp_so3(0.5 * beta * across) @ r)[0], curvature(beta), atol=1e-6)
    assert np.isclose(abs(derivatives(exp_so3(0.25 * np.pi * across) @ r, r, across)[1]), 4.0, atol=1e-3)


def test_maps_hold_wherever_the_axes_are_in_their_cells(directions):
    rng = np.random.default_rng(12)
    R, vectors, weights = walls(directions, rng, (0.3, 0.2, 0.1))
    cells = branch_and_bound_kernels.image(group_directions(vectors, weights), SEARCH._grid, SEARCH._cones, INLIER)
    middle = coarser(cells, FACE[2])
    maps = (coarser(middle, FACE[1]), middle, cells)
    for level, radius_deg in enumerate((9.742, 4.871, 2.435)):
        near = largest_near(maps[level], SEARCH._reaches[level])
        for _ in range(300):
            centre = R @ exp_so3(np.radians(rng.uniform(0.0, 20.0)) * directions.spherical(rng, 1)[0])
            turned = exp_so3(np.radians(radius_deg) * directions.spherical(rng, 1)[0]) @ centre
            assert branch_and_bound_kernels._look_up(near, centre) >= consensus(vectors, weights, turned)[0]
            assert branch_and_bound_kernels._look_up(cells, turned) >= consensus(vectors, weights, turned)[0]


def test_cells_of_the_sphere(directions):
    rng = np.random.default_rng(13)
    grid, n = sphere_grid(8), 8
    near = neighbours(grid, np.radians(5.0))
    points = directions.spherical(rng, 3000)
    cells = np.array([cell_of(*p, n) for p in points])
    assert set(cells) == set(range(3 * n * n)) and all(cell_of(*c, n) == i for i, c in enumerate(grid.centres))
    assert all(cell_of(*(-2.0 * p), n) == c for p, c in zip(points[:200], cells))
    assert np.all(np.arccos(np.clip(np.abs((grid.centres[cells] * points).sum(axis=1)), 0.0, 1.0)) <= grid.radii[cells] + 1e-9)
    for i in range(300):
        close = np.abs(points @ points[i]) >= np.cos(np.radians(5.0))
        assert set(cells[close]) <= set(near.cells[near.first[cells[i]] : near.first[cells[i] + 1]])


def test_climb_never_descends_and_ends_on_a_summit(directions):
    rng = np.random.default_rng(14)
    for _ in range(20):
        R, vectors, weights = walls(directions, rng, (0.3, 0.2, 0.1))
        groups = group_directions(vectors, weights)
        start = R @ exp_so3(np.radians(8.0) * directions.spherical(rng, 1)[0])
        values = [climb(groups, start, INLIER, steps)[1] for steps in (1, 2, 3, 5, 10, 30)]
        assert all(b >= a * (1.0 - 1e-12) for a, b in pairwise(values)) and np.isclose(values[0], consensus(vectors, weights, start)[0])
        top, best = climb(groups, start, INLIER, 60)
        around = [exp_so3(1e-3 * axis) @ top for axis in directions.spherical(rng, 100)]
        assert np.allclose(top.T @ top, np.eye(3)) and consensus(vectors, weights, around).max() < best


@pytest.mark.parametrize("vectors", [np.zeros((0, 3)), np.zeros((4, 3)), np.full((3, 3), np.nan), np.array([[np.inf, 0.0, 0.0]])])
def test_nothing_to_search_in(vectors):
    found = SEARCH(vectors, np.ones(len(vectors)), np.eye(3))
    assert found.cubes == 0 and found.consensus == found.upper == 0.0 and np.array_equal(found.R, np.eye(3))


def test_length_and_bad_rows_make_no_difference(directions):
    rng = np.random.default_rng(15)
    _, vectors, weights = walls(directions, rng, (0.3, 0.3))
    plain = SEARCH(vectors, weights, np.eye(3))
    worse = np.concatenate([2.0 * vectors, [[np.nan, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]])
    found = SEARCH(worse, np.concatenate([weights, [1.0, 1.0, 0.0]]), np.eye(3))
    assert np.allclose(found.R, plain.R) and found.cubes == plain.cubes
    assert np.array_equal(SEARCH(vectors, weights, np.eye(3)).R, plain.R)
