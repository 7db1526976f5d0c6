"""Positions that are linear once the rotation is known: `irls` and `kalman`, in a room that is known."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.record.codec import Decoder, Encoder
from trihedron.plugins.rotation.manhattan import ManhattanRotation
from trihedron.plugins.translation.irls import Irls
from trihedron.plugins.translation.kalman import Kalman

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import INTO_CORNER, World, camera_at, pose_of, rotation_of, tracks_of


def irls(world, tracks, a, b, now, before, **options):
    rotation = rotation_of(camera_at(now), now, sigma_deg=0.05)
    return Irls(**options)(world.frame(now).camera, rotation, tracks, b, a, pose_of(camera_at(before), before), None)


def test_exact_points_give_the_exact_position():
    world = World(noise=0.0)
    found = irls(world, *tracks_of(world, 0, 2), 2, 0)
    assert np.allclose(found.t_world_camera, camera_at(2)[:3, 3], atol=1e-5) and found.estimated and not len(found.unobservable)


def test_the_position_and_its_covariance_under_noise():
    chi2, errors = [], []
    for seed in range(20):
        world = World(points=3000, seed=seed)
        found = irls(world, *tracks_of(world, 0, 2), 2, 0)
        error = found.t_world_camera - camera_at(2)[:3, 3]
        errors.append(np.linalg.norm(error))
        chi2.append(error @ np.linalg.solve(found.covariance, error))
    assert np.sqrt(np.mean(np.square(errors))) < 0.006 and 1.0 < np.mean(chi2) < 6.0  # of a step of 4.7 cm; along the view it is least certain


def test_wrong_pairs_do_not_move_it():
    world = World(noise=0.0)
    tracks, a, b = tracks_of(world, 0, 2)
    swapped = tracks.keypoints.copy()
    swapped[::3, 1] = np.roll(swapped[::3, 1], 1)
    found = irls(world, replace(tracks, keypoints=swapped), a, b, 2, 0)
    assert np.linalg.norm(found.t_world_camera - camera_at(2)[:3, 3]) < 1e-3


def test_points_without_depth_say_the_direction():
    """Five points with depth leave the position loose; with the bearing of many without depth it is better. `depthless=false` ignores these."""
    errors = {True: [], False: []}
    for seed in range(10):
        world = World(points=3000, seed=seed)
        tracks, a, b = tracks_of(world, 0, 4)
        few = tracks.points_m.copy()
        known = np.flatnonzero(np.isfinite(few[:, 0]))
        few[known[8:]] = np.nan
        for depthless, found in errors.items():
            t = irls(world, replace(tracks, points_m=few), a, b, 4, 0, depthless=depthless).t_world_camera
            found.append(np.linalg.norm(t - camera_at(4)[:3, 3]))
    assert np.mean(errors[True]) < 0.8 * np.mean(errors[False])


@pytest.mark.parametrize("depth", [False, True])
def test_too_few_points_are_no_measurement(depth):
    world = World()
    found = irls(world, *tracks_of(world, 0, 2, depth, most=4), 2, 0)
    assert not found.estimated and np.array_equal(found.t_world_camera, np.zeros(3)) and len(found.unobservable) == 3


def filtered(world, steps, points=True, forgetful=False):
    """The filter's values over a walk in which every plane stands on the axes of the room; a forgetful one finds others' before."""
    stage, previous, pose, out = Kalman(), None, None, []
    before = None
    for step in range(steps):
        T = camera_at(step)
        R_world_manhattan = INTO_CORNER[:3, :3]
        rotation = replace(
            rotation_of(T, step, sigma_deg=0.05), R_world_manhattan=R_world_manhattan[None],
            R_camera_manhattan=(T[:3, :3].T @ R_world_manhattan)[None], ids=np.zeros(1, np.int32), weights=np.ones(1),
        )  # fmt: skip
        tracks = tracks_of(world, step - 1, step)[0] if step and points else None
        keypoints = world.keypoints(T, step)[0]
        previous = stage(world.frame(step).camera, rotation, tracks, keypoints, world.plane_regions(T, step)[0], before, pose, previous)
        pose, before = pose_of(np.block([[rotation.R_world_camera, previous.t_world_camera[:, None]], [np.zeros(3), 1.0]]), step), keypoints
        out.append(previous)
        if forgetful:
            previous = replace(previous, filtered_planes=np.empty((0, 4)), filtered_covariance=np.empty((0, 0)))
    return out


def test_planes_on_the_axes_hold_the_position_without_a_point():
    """Three walls measure the step; their offsets are the room's."""
    world = World()
    found = filtered(world, 15, points=False)
    assert np.linalg.norm(found[-1].t_world_camera - camera_at(14)[:3, 3]) < 0.01  # of 34 cm
    for plane in found[-1].filtered_planes:
        assert np.abs(world.planes - plane).max(axis=1).min() < 0.02
    assert found[-1].inliers[2] >= 3 and found[-1].estimated and not len(found[-1].unobservable)


def test_a_translation_of_another_plugin_is_where_the_filter_begins():
    """As in a replay that computes this stage alone, on the recorded past of another."""
    found = filtered(World(), 15, forgetful=True)
    assert np.linalg.norm(found[-1].t_world_camera - camera_at(14)[:3, 3]) < 0.02 and found[-1].inliers[2] == 0
    assert len(found[-1].filtered_planes) >= 3 and found[-1].covariance.trace() > found[1].covariance.trace() > 0.0


def test_the_state_is_a_joint_gaussian_and_survives_recording():
    found = filtered(World(seed=3), 15)
    for value in found:
        P, m = value.filtered_covariance, len(value.filtered_planes)
        assert P.shape == (3 + m, 3 + m) and np.allclose(P, P.T) and np.linalg.eigvalsh(P).min() > -1e-12
    assert found[-1].filtered_covariance[3, 3] < found[0].filtered_covariance[3, 3]  # a wall seen again is known better
    error = found[-1].t_world_camera - camera_at(14)[:3, 3]
    assert error @ np.linalg.solve(found[-1].covariance, error) < 16.3  # 99.9 % of three degrees of freedom
    back = Decoder("file").decode(Encoder().encode(found[-1]))
    assert np.array_equal(back.filtered_covariance, found[-1].filtered_covariance)


def test_the_rotation_of_the_manhattan_frame_alone(room):
    """It is the frame's, whichever of the 24 names it comes under; without support it is held, and says so."""
    rng, stage, previous = np.random.default_rng(0), ManhattanRotation(), None
    empty = World().keypoints(np.eye(4), 0, keep=0.0)[0]
    for step in range(12):
        R = camera_at(5 * step)[:3, :3]
        seen = room().manhattan(R, step, rng, sigma_deg=1e-6, axes=INTO_CORNER[:3, :3], supported=step != 6, turn=step)
        found = stage(seen, replace(empty, index=step), previous)
        error = np.degrees(np.arccos(np.clip((np.trace(R.T @ found.R_world_camera) - 1.0) / 2.0, -1.0, 1.0)))
        if step == 6:
            assert found.source == "prediction" and np.allclose(found.R_world_camera, previous.R_world_camera)
            assert np.trace(found.covariance) > np.trace(previous.covariance)
        else:
            assert error < 1e-3 and found.source == ("manhattan" if step else "prediction")
        previous = found
