"""Normalised errors: what covariances that are honest, too small, and honest in one direction only give."""

import numpy as np
import pytest

from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.run.consistency import pose_consistency, truth_noise

SOMEWHERE = exp_se3(np.array([3.0, -1.0, 2.0, 0.4, -2.0, 1.0]))


def trajectory(count=2000, seed=0):
    """Poses, their covariances, and truths drawn from them."""
    rng = np.random.default_rng(seed)
    poses = np.array([exp_se3(np.concatenate([rng.uniform(-2, 2, 3), rng.uniform(-1.5, 1.5, 3)])) for _ in range(count)])
    shape = rng.normal(size=(count, 6, 6)) * 1e-3
    covariances = shape @ np.swapaxes(shape, 1, 2) + 1e-8 * np.eye(6)
    errors = np.array([rng.multivariate_normal(np.zeros(6), C) for C in covariances])
    return poses, covariances, np.array([T @ exp_se3(e) for T, e in zip(poses, errors)])


def test_honest_covariances_give_six():
    found = pose_consistency(*trajectory())
    assert abs(found.nees_mean - 6.0) < 0.3 and abs(found.nees_median - 5.348) < 0.3
    assert abs(found.share_within_95 - 0.95) < 0.015 and found.poses == 2000
    assert np.abs(np.array(found.normalised_rms) - 1.0).max() < 0.06


@pytest.mark.parametrize("factor", [0.25, 4.0])
def test_covariances_that_are_wrong_by_a_factor_show_it(factor):
    poses, covariances, truth = trajectory()
    found = pose_consistency(poses, factor * covariances, truth)
    assert found.nees_mean * factor == pytest.approx(6.0, abs=0.3)
    assert (found.share_within_95 > 0.95) == (factor > 1.0)


def test_the_world_of_the_truth_does_not_matter():
    poses, covariances, truth = trajectory(200)
    here, there = pose_consistency(poses, covariances, truth), pose_consistency(poses, covariances, SOMEWHERE @ truth)
    assert there.nees_mean == pytest.approx(here.nees_mean, rel=1e-9)
    assert there.normalised_rms == pytest.approx(here.normalised_rms, rel=1e-9)


def test_a_direction_that_is_worse_than_it_says_is_named():
    poses, covariances, _ = trajectory()
    covariances = np.broadcast_to(1e-6 * np.eye(6), covariances.shape)
    rng = np.random.default_rng(1)
    errors = rng.normal(size=(len(poses), 6)) * 1e-3 * np.array([1, 1, 5, 1, 1, 1])
    found = pose_consistency(poses, covariances, np.array([T @ exp_se3(e) for T, e in zip(poses, errors)]))
    assert np.argmax(found.normalised_rms) == 2 and found.normalised_rms[2] == pytest.approx(5.0, abs=0.3)


@pytest.mark.parametrize("noisy", [False, True])
def test_noise_of_the_truth_is_estimated_and_counted_in(noisy):
    """A drift that no neighbours show, white errors of the estimate of 1 mm and 1 mrad, and of the truth of 4 mm and 3 mrad, or none."""
    count, rng = 1500, np.random.default_rng(3)
    sigma = np.repeat([4e-3, 3e-3], 3) * noisy
    own, drift = 1e-3 * rng.normal(size=(count, 6)), np.cumsum(1e-5 * rng.normal(size=(count, 6)), axis=0)
    true = np.array([exp_se3(np.array([0.01 * k, 0.0, 0.0, 0.0, 0.002 * k, 0.0])) for k in range(count)])
    poses = np.array([T @ exp_se3(e + d) for T, e, d in zip(true, own, drift)])
    measured = np.array([T @ exp_se3(sigma * e) for T, e in zip(true, rng.normal(size=(count, 6)))])
    local = np.broadcast_to(1e-6 * np.eye(6), (count, 6, 6))
    noise = truth_noise(poses, local, measured, np.arange(count, dtype=np.int32))
    assert (noise.sigma_m, noise.sigma_rad) == pytest.approx((4e-3 * noisy, 3e-3 * noisy), rel=0.05, abs=4e-4)
    stated = local + np.arange(1, count + 1)[:, None, None] * 1e-10 * np.eye(6)
    found = pose_consistency(poses, stated, measured, noise)
    assert found.nees_mean == pytest.approx(6.0, abs=0.8) and found.truth_sigma_m == noise.sigma_m
    every_third = truth_noise(poses, local, measured, np.arange(0, 3 * count, 3, dtype=np.int32))  # frames of dataset.frames=::3
    assert every_third == noise
    assert truth_noise(poses[:1], local[:1], measured[:1], np.array([0], np.int32)).sigma_m == 0.0


def test_frames_that_follow_a_gap_say_nothing_about_the_noise_of_the_truth():
    """Frames are missing behind every third, and the estimate is off by 10 cm more after each gap."""
    count = 300
    indices = np.arange(count, dtype=np.int32) + 5 * (np.arange(count, dtype=np.int32) // 3)
    true = np.broadcast_to(np.eye(4), (count, 4, 4))
    poses = true.copy()
    poses[:, 0, 3] = 0.1 * (np.arange(count) // 3)
    local = np.broadcast_to(1e-6 * np.eye(6), (count, 6, 6))
    assert truth_noise(poses, local, true, indices).sigma_m == 0.0
