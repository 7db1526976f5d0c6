"""The turn of a map that errors of the calibration explain: a camera that looks round with a focal length that is wrong."""

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.lie import adjoint, exp_so3
from trihedron.pipeline.core.types import CALIBRATION
from trihedron.plugins.loop.calibration_turn import errors_by_calibration

COUNT = 48
SIGMA = np.radians(0.4)  # of the directions of a keyframe
INFORMATION = np.broadcast_to(np.eye(3) / SIGMA**2, (COUNT, 3, 3))
FOCAL, THETA = 0.003, 1.4  # standard deviation of the focal length, and its error in these


def walk():
    """Poses (k, 4, 4) of a camera that looks round one and a half times as it walks, and their sensitivity (k, 6, 12): the focal length turns it by
    its share of the turn, the registration of depth tips it a little."""
    yaw = np.linspace(0.0, 3.0 * np.pi, COUNT)
    poses = np.array([pose_matrix(exp_so3(np.array([0.0, a, 0.0])), np.array([0.2 * i, 0.0, np.sin(a)])) for i, a in enumerate(yaw)])
    sensitivity = np.zeros((COUNT, 6, CALIBRATION))
    sensitivity[:, 4, 0], sensitivity[:, 0, 0], sensitivity[:, 3, 5] = FOCAL * yaw, 0.002 * yaw, 1e-4 * np.sin(yaw)
    return poses, sensitivity


def noise(seed, together=1):
    """Errors (k, 3) of the directions, the same for so many keyframes in a row."""
    return SIGMA * np.repeat(np.random.default_rng(seed).normal(size=(COUNT // together, 3)), together, axis=0)


def angles_deg(xi):
    return np.degrees(np.linalg.norm(xi[:, 3:], axis=1))


def test_a_wrong_focal_length_is_undone():
    poses, sensitivity = walk()
    truth = THETA * sensitivity[:, :, 0]
    xi = errors_by_calibration(poses, truth[:, 3:] + noise(0), INFORMATION, sensitivity, sensitivity[:, 3:], 0).xi
    assert angles_deg(truth).max() > 2.0 and angles_deg(xi - truth).max() < 0.25
    assert np.abs(xi - truth)[:, :3].max() < 0.1 * np.abs(truth[:, :3]).max()  # the position moves with the rotation


def test_what_is_undone_is_no_error_by_the_calibration_any_more():
    """The sensitivity that is left, times the error of the calibration, is the error that is left; without directions it stays."""
    poses, sensitivity = walk()
    theta = THETA * np.eye(CALIBRATION)[0]
    truth = sensitivity @ theta
    undone = errors_by_calibration(poses, truth[:, 3:], INFORMATION, sensitivity, sensitivity[:, 3:], 0)
    remaining = undone.sensitivity @ theta
    assert truth - undone.xi == pytest.approx(remaining, abs=1e-9) and np.abs(remaining).max() < 0.1 * np.abs(truth).max()
    assert undone.sensitivity[:, 3, 5] == pytest.approx(sensitivity[:, 3, 5], rel=0.5, abs=1e-5)  # what the directions hardly show stays
    nothing = errors_by_calibration(poses, 0.0 * truth[:, 3:], INFORMATION, sensitivity, sensitivity[:, 3:], 0)
    assert np.array_equal(nothing.sensitivity, sensitivity) and not nothing.covariance.any()


def test_the_covariance_is_that_of_what_is_undone():
    """Over 200 maps whose directions err at random: the scatter of xi is its stated covariance."""
    poses, sensitivity = walk()
    truth = THETA * sensitivity[:, 3:, 0]
    undone = [errors_by_calibration(poses, truth + noise(seed), INFORMATION, sensitivity, sensitivity[:, 3:], 0) for seed in range(200)]
    scatter = np.array([one.xi[-1, 4] for one in undone]).std()
    assert scatter == pytest.approx(np.sqrt(undone[0].covariance[-1, 4, 4]), rel=0.15)


def test_a_common_rotation_of_the_axes_moves_nothing():
    poses, sensitivity = walk()
    common = np.radians([0.3, -0.8, 0.5])
    xi = errors_by_calibration(poses, np.swapaxes(poses[:, :3, :3], 1, 2) @ common + noise(1), INFORMATION, sensitivity, sensitivity[:, 3:], 0).xi
    assert not xi.any()


def test_what_was_aligned_before_stays_and_the_rest_follows():
    poses, sensitivity = walk()
    since = 24
    carried = adjoint(invert(poses[since:]) @ poses[since]) @ sensitivity[since]
    truth = np.zeros((COUNT, 6))
    truth[since:] = THETA * (sensitivity[since:] - carried)[:, :, 0]
    xi = errors_by_calibration(poses, truth[:, 3:] + noise(2), INFORMATION, sensitivity, sensitivity[:, 3:], since).xi
    assert angles_deg(truth).max() > 0.9 and angles_deg(xi - truth).max() < 0.3


def test_errors_of_the_directions_tell_of_the_calibration_and_are_not_followed():
    """Directions that the calibration turns where it moves no pose, as a rolling shutter tilts vertical edges while the camera walks: no keyframe is
    turned after them, and they count as what they are."""
    poses, sensitivity = walk()
    turns = sensitivity[:, 3:].copy()
    turns[:, 0, 11] = np.radians(1.0) * np.sin(np.linspace(0.0, 20.0, COUNT))
    theta = np.zeros(CALIBRATION)
    theta[[0, 11]] = THETA, 1.5
    xi = errors_by_calibration(poses, turns @ theta + noise(2), INFORMATION, sensitivity, turns, 0).xi
    truth = sensitivity @ theta
    assert angles_deg(xi - truth).max() < 0.25
    wrong = errors_by_calibration(poses, turns @ theta + noise(2), INFORMATION, sensitivity, sensitivity[:, 3:], 0).xi
    assert angles_deg(wrong - truth).max() > angles_deg(xi - truth).max()


@pytest.mark.parametrize("together", [1, 4, 8])
def test_directions_that_err_hardly_ever_turn_the_map(together):
    """One map in fifty at most, whether errors are independent or those of walls that several keyframes in a row see."""
    poses, sensitivity = walk()
    turns = sensitivity[:, 3:]
    moved = [
        errors_by_calibration(poses, noise(seed, together), INFORMATION, sensitivity, turns, since).xi.any()
        for seed in range(50)
        for since in (0, 24)
    ]
    assert sum(moved) <= 2


def test_an_exact_calibration_explains_nothing():
    poses, sensitivity = walk()
    drift = np.radians(2.0) * np.linspace(0.0, 1.0, COUNT)[:, None] * [0.0, 1.0, 0.0]
    assert not errors_by_calibration(poses, drift, INFORMATION, np.zeros_like(sensitivity), np.zeros_like(sensitivity[:, 3:]), 0).xi.any()
    unseen = np.zeros((COUNT, 3, 3))  # nor do keyframes without directions
    assert not errors_by_calibration(poses, drift, unseen, sensitivity, sensitivity[:, 3:], 0).xi.any()
