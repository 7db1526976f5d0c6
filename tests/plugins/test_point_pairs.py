"""Points paired by descriptors, and what most pairs agree on: rotation and translation `ransac`, tracks `brute_force`, matches `keyframes`, loop
`pose_graph`, in a room that is known."""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.lie import exp_se3, exp_so3, rotation_angle_deg
from trihedron.plugins.loop.keyframe_correction import correct_keyframes
from trihedron.plugins.loop.pose_graph import PoseGraph
from trihedron.plugins.mapping.correction import apply_correction
from trihedron.plugins.matches.keyframes import Keyframes
from trihedron.plugins.rotation.ransac import Ransac as RotationRansac
from trihedron.plugins.tracks.brute_force import BruteForce
from trihedron.plugins.translation.irls import Irls
from trihedron.plugins.translation.ransac import Ransac as TranslationRansac

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import World, camera_at, pose_of, rotation_of, tracks_of
from map_steps import EVERY, rows_of_world, walk

PER_POINT = ("pixels", "points_m", "sigma_px", "sigma_m", "octaves", "angles_deg", "descriptors")
SQUARE, SIDE_M = 24, 1.0  # frames once round
DRIFT = np.array([0.20, -0.05, 0.12, np.radians(1.0), np.radians(4.0), np.radians(-1.0)])  # xi at its end


def rng():
    return np.random.default_rng(0)


def taken(keypoints, rows):
    return replace(keypoints, **{name: getattr(keypoints, name)[rows] for name in PER_POINT})


def with_walker(tracks, share=0.4):
    """Tracks of which a share stand on someone who walked by 0.3 m and turned by 11 degrees since: wrong all alike, but for 5 cm."""
    draw, points = np.random.default_rng(5), tracks.points_m.copy()
    on = draw.random(len(points)) < share
    points[on] = points[on] @ exp_so3(np.array([0.0, 0.2, 0.0])).T + [0.3, 0.0, 0.0] + draw.normal(0.0, 0.05, (on.sum(), 3))
    return replace(tracks, points_m=points.astype(np.float32))


def position(tracks, now, step, before=0):
    rotation = rotation_of(camera_at(step), step)
    return TranslationRansac()(rotation, tracks, now, pose_of(camera_at(before), before), None, rng())


def turned(tracks, now, before=0):
    return RotationRansac()(tracks, now, rotation_of(camera_at(before), before), pose_of(camera_at(before), before), None, rng())


@pytest.mark.parametrize(("noise", "limit_m", "limit_deg"), [(0.0, 1e-5, 1e-3), (1.0, 0.008, 0.5)])
def test_two_fifths_of_outliers_move_neither_position_nor_rotation(noise, limit_m, limit_deg):
    for seed in range(5):
        tracks, _, now = tracks_of(World(4000, seed, noise), 1, 4)
        found, rotation = position(with_walker(tracks), now, 4, 1), turned(with_walker(tracks), now, 1)
        error = found.t_world_camera - camera_at(4)[:3, 3]
        degrees = rotation_angle_deg(rotation.R_world_camera.T @ camera_at(4)[:3, :3])
        assert np.linalg.norm(error) < limit_m and degrees < limit_deg  # of 7.1 cm and 1.9 degrees
        assert found.estimated and not len(found.unobservable) and found.inliers[0] > 0.4 * np.isfinite(tracks.points_m[:, 0]).sum()
        assert rotation.source == "tracks" and np.trace(rotation.covariance) < 3.0 * np.radians(0.5) ** 2


def test_too_few_pairs_or_none_alike_are_no_measurement():
    tracks, _, now = tracks_of(World(4000), 1, 4)
    few, _, _ = tracks_of(World(4000), 1, 4, most=8)
    scattered = replace(tracks, points_m=rng().uniform(-3.0, 3.0, tracks.points_m.shape).astype(np.float32))
    for poor in (few, scattered, replace(tracks, previous_index=0), None):
        found, rotation = position(poor, now, 4, 1), turned(poor, now, 1)
        assert not found.estimated and np.array_equal(found.t_world_camera, camera_at(1)[:3, 3]) and len(found.unobservable) == 3
        assert np.allclose(found.covariance, 0.3**2 * np.eye(3))  # three frames of 0.1 m
        assert rotation.source == "prediction" and np.allclose(rotation.R_world_camera, camera_at(1)[:3, :3])
    assert TranslationRansac()(rotation_of(np.eye(4), 0), None, now, None, None, rng()).estimated
    assert np.array_equal(RotationRansac()(None, now, None, None, None, rng()).R_world_camera, np.eye(3))


def test_a_lost_pose_hands_on_how_uncertain_it_is():
    """What is put on top of it is as uncertain, in the world's axes, whether the step was measured or not."""
    tracks, before, now = tracks_of(World(4000), 1, 4)
    T, own = camera_at(1), np.diag([0.5, 0.2, 0.1, 1e-8, 1e-8, 1e-8])
    sure, world = pose_of(T, 1), T[:3, :3] @ own[:3, :3] @ T[:3, :3].T
    lost = replace(sure, status="lost", covariance=own)
    rotation, camera = rotation_of(camera_at(4), 4), World().frame(4).camera
    for pairs in (tracks, None):
        ransac = [TranslationRansac()(rotation, pairs, now, pose, None, rng()) for pose in (sure, lost)]
        irls = [Irls()(camera, rotation, pairs, now, before, pose, None) for pose in (sure, lost)]
        for one, other in (ransac, irls):
            assert np.allclose(other.covariance - one.covariance, world) and np.array_equal(other.t_world_camera, one.t_world_camera)


def brute_force(world, now, before, step=4):
    _, segments, planes = world.features(camera_at(step), step)
    return BruteForce()(world.frame(step).camera, now, segments, planes, before, *world.features(camera_at(0), 0)[1:], None)


def test_descriptors_in_any_order_are_matched():
    """No prediction: the same pairs whether the points stand where they are or on each other's places."""
    world = World(600)
    (before, rows_before), (now, rows_now) = world.keypoints(camera_at(0), 0), world.keypoints(camera_at(4), 4)
    order = rng().permutation(len(rows_now))
    found = brute_force(world, taken(now, order), before)
    i, j = found.keypoints.T
    both = len(np.intersect1d(rows_before, rows_now))
    assert np.array_equal(rows_before[i], rows_now[order][j]) and len(i) >= 0.97 * both > 40
    assert np.array_equal(found.points_m, before.points_m[i], equal_nan=True) and found.previous_index == 0
    lines, lines_before = world.segments(camera_at(4), 4)[1], world.segments(camera_at(0), 0)[1]
    assert len(found.segments) >= 5 and np.array_equal(lines_before[found.segments[:, 0]], lines[found.segments[:, 1]])
    walls, walls_before = world.plane_regions(camera_at(4), 4)[1], world.plane_regions(camera_at(0), 0)[1]
    assert len(found.planes) == 3 and np.array_equal(walls_before[found.planes[:, 0]], walls[found.planes[:, 1]])
    assert rotation_angle_deg(found.R_current_previous @ camera_at(4)[:3, :3]) < 0.3  # of 2.6 degrees
    elsewhere = replace(now, pixels=now.pixels[order], points_m=now.points_m[order])
    assert np.array_equal(brute_force(world, elsewhere, before).keypoints, brute_force(world, now, before).keypoints)


def test_ambiguous_and_foreign_descriptors_are_refused():
    world = World(600)
    (before, rows_before), (now, rows_now) = world.keypoints(camera_at(0), 0), world.keypoints(camera_at(4), 4)
    bits = now.descriptors.copy()
    bits[:, 0] ^= 0b111  # as pixels' noise changes them
    twin = rows_now[:20]
    doubled = taken(replace(now, descriptors=bits), np.concatenate([np.arange(len(rows_now)), np.arange(20)]))
    found = rows_before[brute_force(world, doubled, before).keypoints[:, 0]]
    both = np.intersect1d(rows_before, rows_now)
    assert np.isin(twin, both).sum() >= 10 and not np.isin(found, twin).any()
    assert len(found) >= 0.97 * np.count_nonzero(~np.isin(both, twin))
    twice = taken(before, np.concatenate([np.arange(len(rows_before)), np.arange(len(rows_before))]))
    pairs = brute_force(world, now, twice).keypoints  # a feature of this frame is nearest to two, and goes to one
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs) >= 0.97 * len(both)
    foreign = replace(now, descriptors=rng().integers(0, 256, now.descriptors.shape, dtype=np.uint8))
    assert len(brute_force(world, foreign, before).keypoints) < 0.1 * len(both)


def test_old_features_are_not_looked_for():
    world = World(600)
    before, now = world.keypoints(camera_at(0), 0)[0], world.keypoints(camera_at(1), 11)[0]
    found = brute_force(world, now, before, step=11)
    assert len(found.keypoints) == len(found.segments) == len(found.planes) == 0
    assert BruteForce()(world.frame(0).camera, *world.features(np.eye(4), 0), None, None, None, None) is None


@cache
def walked():
    """A room, the map of a walk of five keyframes through it, and the world's row of each point."""
    world = World(2500)
    map = walk(world, 5, stride=2)
    return world, map, rows_of_world(world, map)


def matched(keypoints, map, **options):
    """Sought without a pose: what is said of the rotation is wrong by a right angle."""
    return Keyframes(**options)(World().frame(12).camera, rotation_of(camera_at(12), 12, off_deg=90.0), keypoints, map, rng())


@pytest.mark.parametrize("wrong", [0.0, 0.4])
def test_points_of_several_keyframes_are_found_wherever_they_are(wrong):
    world, map, landmarks = walked()
    keypoints, rows = world.keypoints(camera_at(12), 12)
    on = np.flatnonzero(rng().random(len(rows)) < wrong)
    bits = keypoints.descriptors.copy()
    bits[on], rows[on] = bits[np.roll(on, 1)], -1
    found = matched(replace(keypoints, descriptors=bits), map)
    i, j = found.keypoints.T
    right = rows[i] == landmarks[j]
    both = np.intersect1d(rows[np.isfinite(keypoints.points_m[:, 2])], landmarks)
    assert right.mean() > 0.98 and len(i) >= 0.8 * len(both) > 60
    assert len(set(i.tolist())) == len(i) == len(set(j.tolist())) and np.array_equal(found.visible_points, np.unique(j))


def test_keyframes_that_do_not_agree_are_not_matched():
    world, map, _ = walked()
    keypoints, _ = world.keypoints(camera_at(12), 12)
    strange = World(2500, seed=1).keypoints(camera_at(12), 12)[0]
    shuffled = replace(keypoints, descriptors=rng().permutation(keypoints.descriptors))
    for other in (strange, shuffled):
        assert not len(matched(other, map).keypoints)
    assert not len(matched(keypoints, None).keypoints) and matched(keypoints, None).map_revision == -1
    assert len(matched(keypoints, map, min_points=25).keypoints) and not len(matched(keypoints, map, min_points=500).keypoints)


def true_pose(index):
    """Once round a square, turning all the way; the last pose stands where the first did, 11 degrees short of its direction."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [0, 0, 0]]) * SIDE_M
    side, along = divmod(4.0 * index / SQUARE, 1.0)
    a, b = corners[int(side) % 4], corners[int(side) % 4 + 1]
    return pose_matrix(exp_so3(np.array([0.0, np.radians(349.0) * index / SQUARE, 0.0])), a + along * (b - a))


@cache
def around():
    """The map of the square in a drifting world: hardly a point is seen twice, but those of the first keyframe by the last one. The map says which
    points are the same at the true poses, then it is bent."""
    world, map, stage = World(2500), None, replace(EVERY, trial=SQUARE)  # where a point not seen again soon is kept
    for index in range(SQUARE + 1):
        T, features = true_pose(index), world.features(true_pose(index), index)
        closing = index == SQUARE
        matches = Keyframes(newest=SQUARE)(world.frame(index).camera, rotation_of(T, index), features[0], map, rng()) if closing else None
        map = stage(world.frame(index), pose_of(T, index), *features, matches, map, None, None, None)
    truth = map.keyframes.column("T_world_camera")
    drifted = np.array([exp_se3(DRIFT * index / SQUARE) @ T for index, T in enumerate(truth)])
    return world, apply_correction(map, correct_keyframes(map, np.arange(SQUARE + 1, dtype=np.int32), truth, drifted)), truth


def test_a_pose_graph_corrects_the_drift_around_a_square():
    _, map, truth = around()
    correction = PoseGraph()(map)
    before, after = (m.keyframes.column("T_world_camera") for m in (map, apply_correction(map, correction)))
    drift, left = (np.linalg.norm(T[:, :3, 3] - truth[:, :3, 3], axis=1) for T in (before, after))
    turn = [rotation_angle_deg(T.T @ R) for T, R in zip(after[:, :3, :3], truth[:, :3, :3])]
    assert drift[-1] > 0.23 and left[-1] < 0.1 * drift[-1] and left.max() < 0.2 * drift.max()
    assert max(turn) < 1.3  # of 4.2 degrees; the loop edge errs by 0.3
    assert np.array_equal(after[0], before[0]) and correction.based_on == map.revision
    assert np.array_equal(correction.point_ids, np.flatnonzero(map.points.column("alive")))


def test_a_pose_graph_without_a_cycle_says_nothing():
    _, map, _ = around()
    assert PoseGraph()(replace(map, index=SQUARE + 1)) is None  # no keyframe was made then
    assert PoseGraph(every=5)(map) is None
    assert PoseGraph(min_points=5000)(map) is None
    assert PoseGraph(least_m=1.0)(map) is None


@pytest.mark.parametrize("judge", [True, False])
def test_a_loop_closes_however_far_the_pose_has_drifted(judge):
    """Where the map judges matches by the drifted pose the edge is lost, as in tracking it should be."""
    world, map, stage = World(2500), None, replace(EVERY, trial=SQUARE, judge=judge)
    for index in range(SQUARE + 1):
        T = exp_se3(DRIFT * index / SQUARE) @ true_pose(index)
        features = world.features(true_pose(index), index)
        matches = Keyframes(newest=SQUARE)(world.frame(index).camera, rotation_of(T, index), features[0], map, rng()) if index == SQUARE else None
        map = stage(world.frame(index), pose_of(T, index), *features, matches, map, None, None, None)
    correction = PoseGraph()(map)
    assert (correction is None) == judge
    if not judge:
        left = np.linalg.norm(apply_correction(map, correction).keyframes.column("T_world_camera")[-1, :3, 3] - true_pose(SQUARE)[:3, 3])
        assert left < 0.1 * np.linalg.norm(map.keyframes.column("T_world_camera")[-1, :3, 3] - true_pose(SQUARE)[:3, 3])
