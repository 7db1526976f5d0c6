"""The error of a loop by the calibration: a keyframe registered at a place that the same miscalibrated camera has mapped."""

import dataclasses

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import exp_se3, log_se3
from trihedron.pipeline.core.types import CALIBRATION, Camera, Matches, Pose
from trihedron.plugins.loop.registration_error import registration_error
from trihedron.plugins.mapping.insertion import add_keyframe
from trihedron.plugins.mapping.landmarks import OBSERVERS, empty_map
from trihedron.plugins.shared.calibration_error import calibration_scales
from trihedron.plugins.shared.pose_optimizer import NO_LINES, NO_PLANES, solve_pose
from trihedron.plugins.shared.residuals_kernels import PointTerms

CAMERA = Camera(640, 480, 520.0, 530.0, 315.0, 245.0)
WEAK = 1e-6 * np.eye(6)
BACK = exp_se3(np.array([0.8, 0.6, -0.5, 0.3, -0.3, 0.1]))  # where the camera comes back to


def seen(points, theta):
    """Pixels and depth (n, 3) of points (n, 3) as a camera measures them whose focal lengths, centre, and depth err by theta (12,)."""
    fx, fy, cx, cy = CAMERA.intrinsics
    x, y, z = points.T
    u, v = fx * (1 + theta[0]) * x / z + cx + theta[2], fy * (1 + theta[1]) * y / z + cy + theta[3]
    radius2 = ((u - cx) ** 2 + (v - cy) ** 2) / (0.25 * (CAMERA.width**2 + CAMERA.height**2))
    return np.stack([u, v, 1.0 / ((1.0 / z - theta[7]) / (1.0 + theta[8] * radius2))], axis=1)


def revisited(theta):
    """A map of a keyframe at the origin with the landmarks that it placed and a second one at BACK, matches of the landmarks, and their terms as the
    second one measures them."""
    rng = np.random.default_rng(0)
    world = CAMERA.back_project(rng.uniform([250, 60], [600, 420], (200, 2)), rng.uniform(1.5, 4.0, 200))
    there, here = seen(world, theta), seen((world - BACK[:3, 3]) @ BACK[:3, :3], theta)
    placed, map, count = CAMERA.back_project(there[:, :2], there[:, 2]), empty_map(0, 0, 32, 32, 4), len(world)
    for i, T in enumerate((np.eye(4), BACK)):
        pose = Pose(i, i * 33_000_000, T, 1e-8 * np.eye(6), T, -1, np.zeros(3, np.int32), 0, "ok", "")
        map, _ = add_keyframe(map, pose, CAMERA)
    points, ids = map.points.appended(
        position_m=placed,
        information=np.tile(1e6 * np.eye(3, dtype=np.float32), (count, 1, 1)),
        descriptor=np.zeros((count, 32), np.uint8),
        direction=np.zeros((count, 3), np.float32),
        distance_m=np.ones(count, np.float32),
        octave=np.zeros(count, np.uint8),
        first=np.zeros(count, np.int32),
        observers=np.tile(np.r_[0, np.full(OBSERVERS - 1, -1)], (count, 1)),
        found=np.ones(count, np.int32),
        visible=np.ones(count, np.int32),
        alive=np.ones(count, np.bool_),
    )
    none, visible = np.empty((0, 2), np.int32), np.empty(0, np.int32)
    matches = Matches(1, 33_000_000, 0, np.stack([ids, ids], axis=1).astype(np.int32), none, none, none, none, visible, visible)
    small, sigma_m = np.tile(1e-6 * np.eye(3), (count, 1, 1)), CAMERA.depth_noise.sigma_m(here[:, 2])
    return (
        dataclasses.replace(map, points=points),
        matches,
        (PointTerms(placed, small, here[:, :2], here[:, 2], np.ones(count), sigma_m), NO_LINES, NO_PLANES),
    )


@pytest.mark.parametrize("parameter", [0, 1, 2, 3, 7, 8])
def test_a_loop_errs_as_two_views_of_a_camera_with_that_error(parameter):
    """The keyframe is registered away from where it is, by what its own measurements and those of the place err differently."""
    unit = 0.2 * np.eye(CALIBRATION)[parameter]
    map, matches, terms = revisited(unit * calibration_scales(CAMERA))
    found = solve_pose(BACK, CAMERA, BACK, WEAK, *terms)
    assert (found.points > 0).all()
    predicted = registration_error(map, CAMERA, matches, terms, found, WEAK)
    error = log_se3(invert(BACK) @ found.T_world_camera)
    assert error == pytest.approx(predicted @ unit, rel=0.1, abs=0.05 * np.abs(error).max())
    assert np.linalg.norm(error[:3]) > 2e-4


def test_a_keyframe_where_the_place_was_seen_from_errs_alike():
    """From the same pose, landmarks that err with the place agree: the loop is exact, whatever the calibration."""
    map, matches, _ = revisited(np.zeros(CALIBRATION))
    there = seen(map.points.column("position_m"), np.zeros(CALIBRATION))
    count = len(there)
    small = np.tile(1e-6 * np.eye(3), (count, 1, 1))
    terms = PointTerms(map.points.column("position_m"), small, there[:, :2], there[:, 2], np.ones(count), CAMERA.depth_noise.sigma_m(there[:, 2]))
    found = solve_pose(np.eye(4), CAMERA, np.eye(4), WEAK, terms)
    at_place = registration_error(map, CAMERA, matches, (terms, NO_LINES, NO_PLANES), found, WEAK)
    assert np.abs(at_place).max() < 1e-6
