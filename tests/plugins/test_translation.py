"""Position with the rotation fixed, in a room that is known."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, pose_matrix, transform_planes
from trihedron.pipeline.core.types import Planes, Pose, Tracks
from trihedron.plugins.translation.levenberg_marquardt import LevenbergMarquardt

sys.path.insert(0, str(Path(__file__).parent))
import itertools

from landmark_world import INTO_CORNER, World, camera_at, rotation_of


def pose_of(T, index):
    return Pose(index, index * 33_000_000, T, np.eye(6) * 1e-8, T, -1, np.zeros(3, np.int32), 0, "ok", "")


def pairs(before, now):
    """Rows (previous, current) of what both saw."""
    _, a, b = np.intersect1d(before, now, return_indices=True)
    return np.stack([a, b], axis=-1).astype(np.int32)


def tracked(world, before, now, points=True, lines=True, planes=True):
    """Features at camera steps `before` and `now`, and the true Tracks between them."""
    (kp0, krow0), (kp1, krow1) = world.keypoints(camera_at(before), before), world.keypoints(camera_at(now), now)
    (se0, srow0), (se1, srow1) = world.segments(camera_at(before), before), world.segments(camera_at(now), now)
    (pl0, prow0), (pl1, prow1) = world.plane_regions(camera_at(before), before), world.plane_regions(camera_at(now), now)
    k, s, p = (pairs(a, b)[: None if use else 0] for a, b, use in ((krow0, krow1, points), (srow0, srow1, lines), (prow0, prow1, planes)))
    R = (invert(camera_at(now)) @ camera_at(before))[:3, :3]
    tracks = Tracks(
        now, now * 33_000_000, before, k, kp0.points_m[k[:, 0]], kp0.sigma_m[k[:, 0]], s, se0.endpoints_m[s[:, 0]], p,
        pl0.coefficients[p[:, 0]], pl0.covariance[p[:, 0]], R,
    )  # fmt: skip
    return tracks, kp1, se1, pl1


def run(world, now, previous=0, rotation=None, **kinds):
    tracks, keypoints, segments, planes = tracked(world, previous, now, **kinds)
    stage = LevenbergMarquardt()
    rotation = rotation or rotation_of(camera_at(now), now, sigma_deg=0.05)
    return stage(world.frame(now).camera, rotation, tracks, keypoints, segments, planes, pose_of(camera_at(previous), previous), None, None)


@pytest.mark.parametrize("kinds, limit_m", [({}, 0.002), ({"points": False}, 0.003), ({"points": False, "lines": False}, 0.004)], ids=str)
def test_the_position_is_found_from_any_kind(kinds, limit_m):
    errors = [np.linalg.norm(run(World(seed=seed), 2, **kinds).t_world_camera - camera_at(2)[:3, 3]) for seed in range(10)]
    assert np.sqrt(np.mean(np.square(errors))) < limit_m  # of a step of 4.7 cm


def test_exact_data_give_the_exact_position():
    found = run(World(noise=0.0), 3)
    assert np.allclose(found.t_world_camera, camera_at(3)[:3, 3], atol=1e-5)
    assert found.estimated and found.inliers.min() > 0 and len(found.unobservable) == 0


def test_the_covariance_is_about_right():
    """The fixed rotation is exact here, so the covariance, which allows for its uncertainty, may only be too large."""
    chi2 = []
    for seed in range(30):
        found = run(World(seed=seed), 2)
        error = found.t_world_camera - camera_at(2)[:3, 3]
        chi2.append(error @ np.linalg.solve(found.covariance, error))
    assert 0.5 < np.mean(chi2) < 4.5


def test_a_poor_rotation_gives_the_planes_more_say():
    """Half a degree moves points by 5 px but the walls' distances not at all: said to be uncertain, it costs less than when it is trusted."""
    world = World(noise=0.0)
    honest, sure = (run(world, 2, rotation=rotation_of(camera_at(2), 2, sigma_deg=s, off_deg=0.5)) for s in (0.5, 0.0))
    error = [np.linalg.norm(found.t_world_camera - camera_at(2)[:3, 3]) for found in (honest, sure)]
    assert error[0] < 0.7 * error[1]


def test_the_first_frame_is_the_origin():
    world = World()
    found = LevenbergMarquardt()(world.frame(0).camera, rotation_of(np.eye(4), 0), None, *world.features(np.eye(4), 0), None, None, None)
    assert found.estimated and not found.t_world_camera.any()


def test_without_tracks_the_prediction_is_kept_and_not_called_an_estimate():
    world = World()
    T = camera_at(5)
    for tracks in (None, tracked(world, 3, 6)[0]):  # none, or of another frame than the pose
        found = LevenbergMarquardt()(world.frame(6).camera, rotation_of(T, 6), tracks, *world.features(T, 6), pose_of(T, 5), None, None)
        assert not found.estimated and not found.inliers.any()
        assert np.array_equal(found.t_world_camera, T[:3, 3])
        assert np.allclose(found.unobservable, np.eye(3))
    nothing = tracked(world, 5, 6, points=False, lines=False, planes=False)
    assert not LevenbergMarquardt()(world.frame(6).camera, rotation_of(T, 6), *nothing, pose_of(T, 5), None, None).estimated


def test_a_bare_corridor_keeps_the_prediction_along_it():
    """Two walls and the floor say nothing of the motion along them; across it the position is found."""
    world = World(noise=0.0)
    T = camera_at(0)
    walls = world.planes[[0, 3, 4]]
    moved = T.copy()
    moved[:3, 3] = [0.03, -0.01, 0.05]
    before, now = walls, transform_planes(invert(moved), walls)
    small = np.tile(np.eye(3) * 1e-6, (3, 1, 1))
    rows = np.tile(np.arange(3, dtype=np.int32)[:, None], 2)
    keypoints, segments, some = world.features(T, 1)
    planes = Planes(1, 33_000_000, now, small, np.tile(np.eye(4), (3, 1, 1)), np.full(3, 9000, np.int32), some.samples_m[[0, 0, 0]], some.labels, 8)
    none = tracked(world, 0, 1, points=False, lines=False, planes=False)[0]
    tracks = Tracks(
        1, 33_000_000, 0, none.keypoints, none.points_m, none.sigma_m, none.segments, none.endpoints_m, rows, before, small, np.eye(3)
    )  # fmt: skip
    found = LevenbergMarquardt()(world.frame(1).camera, rotation_of(T, 1), tracks, keypoints, segments, planes, pose_of(T, 0), None, None)
    along = INTO_CORNER[:3, 2]
    assert np.allclose(found.t_world_camera, moved[:3, 3] - along * (along @ moved[:3, 3]), atol=1e-3)
    assert found.unobservable.shape == (1, 3) and abs(found.unobservable[0] @ along) > 0.999
    assert found.estimated and list(found.inliers) == [0, 0, 3]


@pytest.mark.parametrize("field", ["motion_sigma_m", "line_sigma_px"])
def test_ranges_are_checked(field):
    with pytest.raises(ValueError, match=field):
        LevenbergMarquardt(**{field: 0.0})


def test_without_features_the_camera_goes_on_for_half_a_second_then_stands_ever_less_certain():
    world, stage = World(), LevenbergMarquardt(predict_frames=15)
    nothing = (None, *(None,) * 3)
    poses, found = [pose_of(camera_at(8), 8), pose_of(camera_at(9), 9)], []
    for index in range(10, 60):
        T = camera_at(9)
        found.append(stage(world.frame(index).camera, rotation_of(T, index), *nothing, poses[-1], poses[-2], None))
        T = pose_matrix(T[:3, :3], found[-1].t_world_camera)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = T[:3, :3].T @ found[-1].covariance @ T[:3, :3]
        poses.append(dataclasses.replace(pose_of(T, index), status="lost", covariance=covariance))
    steps = np.array([np.linalg.norm(b.t_world_camera - a.t_world_camera) for a, b in itertools.pairwise(found)])
    assert np.allclose(steps[:14], np.linalg.norm(camera_at(1)[:3, 3])) and np.allclose(steps[15:], 0.0)
    sigma = [np.sqrt(one.covariance[0, 0]) for one in found]
    assert np.allclose(sigma, 0.1 * np.sqrt(np.arange(1, 51)), rtol=1e-3) and not any(one.estimated for one in found)
