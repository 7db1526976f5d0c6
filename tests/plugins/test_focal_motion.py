"""Wrong focal lengths are told from what a frame sees again of the first keyframe, as soon as the camera has turned."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from trihedron.pipeline.core.geometry import exp_se3, transform
from trihedron.plugins.matches.local_map import LocalMap
from trihedron.plugins.pose.focal_length import FocalMotion, focal_motion
from trihedron.plugins.pose.focal_length_kernels import KEYFRAMES, LEAST_POINTS, solve

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import CAMERA, World, camera_at, rotation_of, translation_of
from map_steps import EVERY, walk

OFF, SURE = 0.1, 2.0
FRAME = 20  # its noise is another than that of the keyframes


def told(world, map, wrong, turned_deg, keep=10**9):
    """What a frame says that is turned about an oblique axis and 4 cm away, where all were told focal lengths wrong by a factor."""
    intrinsics = np.tile([wrong * CAMERA.fx, wrong * CAMERA.fy, CAMERA.cx, CAMERA.cy], (len(map.keyframes), 1))
    misled = dataclasses.replace(map, keyframes=map.keyframes.updated(np.arange(len(intrinsics)), intrinsics=intrinsics))
    axis = np.array([0.8, 0.6, 0.0]) * np.radians(turned_deg)
    T = camera_at(0) @ exp_se3(np.concatenate([[0.04, 0.0, 0.0], axis]))
    features, frame = world.features(T, FRAME), world.frame(FRAME)
    matches = LocalMap()(frame.camera, rotation_of(T, FRAME), translation_of(T, FRAME), *features, map, None)
    matches = dataclasses.replace(matches, keypoints=matches.keypoints[:keep])
    camera = dataclasses.replace(CAMERA, fx=wrong * CAMERA.fx, fy=wrong * CAMERA.fy)
    agreed = np.ones(len(matches.keypoints), np.uint8)
    return focal_motion(misled, camera, features[0], matches, agreed, T)


@pytest.fixture(scope="module")
def world():
    return World(3000)


@pytest.fixture(scope="module")
def map(world):
    return walk(world, 1, EVERY)


@pytest.mark.parametrize("wrong", [0.8, 0.95, 1.0, 1.05, 1.2])
def test_the_factor_is_found_within_its_deviation(world, map, wrong):
    found = told(world, map, wrong, 4.0)
    print(wrong, found)
    assert abs(np.log(found.factor * wrong)) < 3.0 * found.sigma < 0.15
    assert ("focal lengths" in found.doubt(OFF, SURE)) == (wrong in (0.8, 1.2))


def test_a_camera_that_does_not_turn_tells_nothing(world, map):
    turned, still = told(world, map, 1.2, 4.0), told(world, map, 1.2, 0.0)
    assert still.sigma > 5.0 * turned.sigma and still.doubt(OFF, SURE) == ""


def test_deviations_are_honest():
    """Over twelve noises of keyframe and frame, and turns of 1° to 5°, the error is about one of them."""
    errors = []
    for seed, turned_deg in enumerate(np.linspace(1.0, 5.0, 12)):
        world = World(1500, seed=seed)
        found = told(world, walk(world, 1, EVERY), 1.0, turned_deg)
        errors.append(np.log(found.factor) / found.sigma)
    print(np.round(errors, 1))
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5


@pytest.mark.parametrize("wrong", [0.8, 1.2])
def test_until_it_is_verified_what_the_factor_does_to_the_pose_is_in_its_covariance(world, map, wrong):
    """Turned by 0.3° nothing is known of the factor; the pose that fits under the wrong one is within the doubt of the true one, where it was not."""
    found = told(world, map, wrong, 0.3)
    assert found.doubt(OFF, SURE) == "" and not found.verified(OFF, SURE)
    assert told(world, map, 1.0, 4.0).verified(OFF, SURE) and not told(world, map, wrong, 4.0).verified(OFF, SURE)
    right, most = found.covariance(OFF), np.log1p(OFF) ** 2 * np.outer(found.effect, found.effect)
    ratio = np.trace(right) / np.trace(most)
    print(f"{wrong}: {found.factor:.2f} ± {found.sigma:.2f}, {ratio:.2f} of the doubt beforehand, {1e3 * np.sqrt(np.trace(right[:3, :3])):.1f} mm")
    assert 0.3 < ratio < 4.0
    known = told(world, map, wrong, 4.0)  # then the pose is known to be off, and the covariance says so
    bias = np.log(known.factor) ** 2 * np.outer(known.effect, known.effect)
    assert np.trace(known.covariance(OFF)) == pytest.approx(np.trace(bias), rel=0.3)


def test_the_effect_is_that_of_other_focal_lengths_on_the_pose():
    """By differences: least squares at two fixed factors, on points without noise but with depths a little off, against what the solver says."""
    rng, told = np.random.default_rng(1), np.array([500.0, 500.0, 320.0, 240.0])
    before = rng.uniform([-1.5, -1.0, 1.5], [1.5, 1.0, 4.0], (60, 3))
    T = exp_se3(np.array([0.05, -0.02, 0.03, 0.03, -0.05, 0.01]))

    def projected(T, factor):
        p = transform(T, before / [factor, factor, 1.0])
        return np.column_stack([factor * told[:2] * p[:, :2] / p[:, 2:] + told[2:], p[:, 2]])

    seen, noise_px, noise_m = projected(T, 1.0), np.full(60, 0.25), np.full(60, 1e-4)
    t = T[:3, 3].copy()
    factor, _, turned, shifted = solve(before, seen, noise_px, noise_m, told, T[:3, :3].copy(), t)
    effect = np.concatenate([np.cross(turned, t) - shifted, -turned])

    def left(xi, factor):  # as motion of the camera in its keyframe's world
        e = projected(exp_se3(-xi) @ T, factor) - seen
        return (e / np.sqrt(np.column_stack([noise_px, noise_px, noise_m]))).ravel()

    moved = least_squares(left, np.zeros(6), args=(1.001,), x_scale=1e-3, xtol=1e-14, ftol=1e-14, gtol=1e-14).x / np.log(1.001)
    print(np.round(moved, 4), np.round(effect, 4))
    assert factor == pytest.approx(1.0, abs=1e-6) and np.allclose(effect, moved, atol=0.03 * np.abs(moved).max())


def test_what_is_within_the_doubt_is_not_said():
    def of(factor, sigma):
        return FocalMotion(factor, sigma, np.zeros(6))

    assert of(1.2, 0.03).doubt(OFF, SURE).startswith("what is seen moves as under focal lengths 1.20 times")
    assert of(1.2, 0.06).doubt(OFF, SURE) == "" and of(1.08, 0.001).doubt(OFF, SURE) == ""
    assert of(1.9, 0.1).doubt(OFF, SURE) == "what is seen does not move as one thing at rest"
    assert "0.80 times" in of(0.8, 0.01).doubt(OFF, SURE)
    assert of(1.02, 0.02).verified(OFF, SURE) and not of(1.02, 0.05).verified(OFF, SURE) and not of(1.2, 0.01).verified(OFF, SURE)


def test_too_few_points_or_enough_keyframes_say_nothing(world, map):
    assert told(world, map, 1.2, 4.0, keep=LEAST_POINTS - 1) is None
    assert told(world, walk(world, KEYFRAMES, EVERY), 1.2, 4.0) is None
