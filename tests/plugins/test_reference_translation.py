"""The fast solver of the translation against the paper's cost, written once by SciPy."""

import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.plugins.translation.levenberg_marquardt import LevenbergMarquardt
from trihedron.plugins.translation.scipy_least_squares import ScipyLeastSquares, residuals, tracked_terms

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import World, camera_at, rotation_of
from test_translation import pose_of, tracked


def both(world, now, **kinds):
    """The positions of the fast solver and of the reference, and the first one's standard deviation, m."""
    tracks, keypoints, segments, planes = tracked(world, 0, now, **kinds)
    common = world.frame(now).camera, rotation_of(camera_at(now), now, sigma_deg=0.001), tracks, keypoints, segments, planes, pose_of(camera_at(0), 0)
    fast, reference = LevenbergMarquardt()(*common, None, None), ScipyLeastSquares()(*common, None)
    return fast, reference


@pytest.mark.parametrize("kinds", [{}, {"points": False}, {"lines": False, "planes": False}], ids=str)
def test_the_fast_solver_finds_the_minimum_of_the_papers_cost(kinds):
    apart, sigmas = [], []
    for seed in range(8):
        fast, reference = both(World(seed=seed), 2, **kinds)
        assert fast.estimated and reference.estimated
        apart.append(np.linalg.norm(fast.t_world_camera - reference.t_world_camera))
        sigmas.append(np.sqrt(np.trace(fast.covariance)))
    assert np.sqrt(np.mean(np.square(apart))) < 2.0 * np.mean(sigmas) and max(apart) < 0.005  # of a step of 4.7 cm


def test_both_are_exact_for_exact_data():
    fast, reference = both(World(noise=0.0), 3)
    truth = camera_at(3)[:3, 3]
    assert np.allclose(fast.t_world_camera, truth, atol=1e-5) and np.allclose(reference.t_world_camera, truth, atol=1e-5)
    assert len(reference.unobservable) == 0 and (reference.inliers > 0).all()


def test_residuals_vanish_at_the_truth_and_not_beside_it():
    world, now = World(noise=0.0), 3
    tracks, keypoints, segments, planes = tracked(world, 0, now)
    motion = np.linalg.inv(camera_at(now)) @ camera_at(0)
    terms = tracked_terms(tracks, keypoints, segments, planes, motion[:3, :3], 1.0, 0.002)
    camera = world.frame(now).camera
    assert all(len(r) and np.abs(r).max() < 0.02 for r in residuals(terms, camera, motion[:3, 3]))
    assert all(np.abs(r).max() > 1.0 for r in residuals(terms, camera, motion[:3, 3] + [0.05, 0.05, 0.05]))


def test_without_features_the_camera_is_at_rest():
    tracks, keypoints, segments, planes = tracked(World(), 0, 2, points=False, lines=False, planes=False)
    rotation = rotation_of(camera_at(2), 2, sigma_deg=0.1)
    found = ScipyLeastSquares()(World().frame(2).camera, rotation, tracks, keypoints, segments, planes, pose_of(camera_at(0), 0), None)
    assert not found.estimated and np.allclose(found.t_world_camera, camera_at(0)[:3, 3])
