"""The turn of a map that errors of the calibration explain: a camera that looks round with a focal length that is wrong."""

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.types import CALIBRATION
from trihedron.plugins.loop import calibration_turn
from trihedron.plugins.loop.calibration_turn import estimate_calibration
from trihedron.plugins.shared.pose_graph import Edges

COUNT = 48
SIGMA = np.radians(0.4)  # of the directions of a keyframe
DRIFT = np.radians(0.05)  # of a keyframe relative to the one before
FOCAL, THETA = 0.003, 1.4  # standard deviation of the focal length, and its error in these
FIRST = np.eye(CALIBRATION)[0]


def walk():
    """Poses (k, 4, 4) of a camera that looks round one and a half times as it walks, and the derivatives (k, 3, 12) of their rotations: the focal
    length turns it by its share of the turn, the registration of depth tips it a little."""
    yaw = np.linspace(0.0, 3.0 * np.pi, COUNT)
    poses = np.array([pose_matrix(exp_so3(np.array([0.0, a, 0.0])), np.array([0.2 * i, 0.0, np.sin(a)])) for i, a in enumerate(yaw)])
    turns = np.zeros((COUNT, 3, CALIBRATION))
    turns[:, 1, 0], turns[:, 0, 5] = FOCAL * yaw, 1e-4 * np.sin(yaw)
    return poses, turns


def noise(seed, together=1):
    """Errors (k, 3) of the directions, the same for so many keyframes in a row."""
    return SIGMA * np.repeat(np.random.default_rng(seed).normal(size=(COUNT // together, 3)), together, axis=0)


def drift(seed):
    """Errors (k, 3) of the poses: a random walk."""
    steps = DRIFT * np.random.default_rng(1000 + seed).normal(size=(COUNT, 3))
    return np.cumsum(steps, axis=0) - steps[0]


def estimate(rotations, turns, seen=True, information=None, score=None):
    """The estimate by directions that turn by `rotations` (k, 3) from keyframe to keyframe, with derivatives `turns` (k, 3, 12), and what residuals
    show, by default nothing."""
    poses, _ = walk()
    pairs = np.stack([np.arange(COUNT - 1), np.arange(1, COUNT)], axis=1)
    chain = Edges(pairs, invert(poses[:-1]) @ poses[1:], np.tile(np.diag(np.repeat([1e4, DRIFT**-2], 3)), (COUNT - 1, 1, 1)))
    pairs = np.stack([np.full(COUNT, COUNT), np.arange(COUNT)], axis=1)
    measured = poses @ np.array([pose_matrix(exp_so3(phi), np.zeros(3)) for phi in rotations])
    direction = np.diag(np.repeat([1e-6, SIGMA**-2 if seen else 0.0], 3))
    edges = Edges(
        np.concatenate([chain.pairs, pairs]),
        np.concatenate([chain.measured, measured]),
        np.concatenate([chain.information, np.tile(direction, (COUNT, 1, 1))]),
    )
    differences = np.pad(turns, ((COUNT - 1, 0), (3, 0), (0, 0)))
    information = np.zeros((CALIBRATION, CALIBRATION)) if information is None else information
    score = np.zeros(CALIBRATION) if score is None else score
    return estimate_calibration(np.concatenate([poses, np.eye(4)[None]]), edges, differences, COUNT, information, score)


def test_a_wrong_focal_length_is_estimated():
    _, turns = walk()
    found = estimate(turns @ (THETA * FIRST) + noise(0), turns)
    sigma = np.sqrt((found.spread[0] ** 2).sum())
    print(f"{found.parameters[0]:.2f} ± {sigma:.2f} σ")
    assert sigma < 0.7 and abs(found.parameters[0] - THETA) < sigma
    assert np.abs(found.parameters[1:]).max() < 0.3 and found.spread[5, 5] > 0.9  # what the directions hardly show stays as unknown as it was


def test_the_spread_is_that_of_the_errors(monkeypatch):
    """Over 300 maps that drift, with calibrations as their prior has them: where the noise is counted once, the errors of the estimates are as large
    as stated."""
    monkeypatch.setattr(calibration_turn, "EXCESS", 1.0)
    _, turns = walk()
    turns[:, 2, 11] = np.radians(1.0) * np.sin(np.linspace(0.0, 20.0, COUNT))
    squared = []
    for seed in range(300):
        theta = np.random.default_rng(5000 + seed).normal(size=CALIBRATION)
        found = estimate(turns @ theta + noise(seed) + drift(seed), turns)
        squared.append(((np.linalg.solve(found.spread, found.parameters - theta)) ** 2)[[0, 11]])
    assert np.mean(squared, axis=0) == pytest.approx(1.0, abs=0.25)


def test_a_common_rotation_of_the_axes_shows_nothing():
    poses, turns = walk()
    common = np.radians([0.3, -0.8, 0.5])
    assert not estimate(np.swapaxes(poses[:, :3, :3], 1, 2) @ common + noise(1), turns).parameters.any()


def test_errors_of_the_directions_tell_of_the_calibration():
    """Directions that the calibration turns where it moves no pose, as a rolling shutter tilts vertical edges while the camera walks."""
    _, turns = walk()
    turns[:, 0, 11] = np.radians(1.0) * np.sin(np.linspace(0.0, 20.0, COUNT))
    theta = THETA * FIRST
    theta[11] = 1.5
    found = estimate(turns @ theta + noise(2), turns)
    sigma = np.sqrt((found.spread**2).sum(axis=1))[[0, 11]]
    assert sigma.max() < 0.7 and (np.abs(found.parameters - theta)[[0, 11]] < sigma).all()


def test_what_residuals_show_is_counted_where_directions_show_the_calibration():
    """Residuals know the registration of depth, which directions hardly show; alone they move no map."""
    _, turns = walk()
    information, score = np.zeros((CALIBRATION, CALIBRATION)), np.zeros(CALIBRATION)
    information[5, 5], score[5] = 3200.0, 3200.0 * -1.2
    found = estimate(turns @ (THETA * FIRST) + noise(0), turns, information=information, score=score)
    assert found.parameters[5] == pytest.approx(-1.2, abs=0.05) and found.spread[5, 5] < 0.15
    assert found.parameters[0] == pytest.approx(THETA, abs=0.6)
    alone = estimate(noise(0), turns, information=information, score=score)
    assert not alone.parameters.any() and np.array_equal(alone.spread, np.eye(CALIBRATION))


@pytest.mark.parametrize("together", [1, 4, 8])
def test_directions_that_err_hardly_ever_show_a_calibration(together):
    """One map in fifty at most, whether errors are independent or those of walls that several keyframes in a row see."""
    _, turns = walk()
    shown = [estimate(noise(seed, together) + drift(seed), turns).parameters.any() for seed in range(100)]
    assert sum(shown) <= 2


def test_what_turns_nothing_explains_nothing():
    _, turns = walk()
    turned = np.radians(2.0) * np.linspace(0.0, 1.0, COUNT)[:, None] * [0.0, 1.0, 0.0]
    exact = estimate(turned, np.zeros_like(turns))
    assert not exact.parameters.any() and np.array_equal(exact.spread, np.eye(CALIBRATION))
    assert not estimate(turned, turns, seen=False).parameters.any()  # nor do keyframes without directions
