"""Features found again in the next frame: known pairs, poor predictions, outliers, missing kinds."""

from dataclasses import replace

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.lie import exp_so3, rotation_angle_deg
from trihedron.pipeline.core.types import Frame, Tracks
from trihedron.plugins.shared.relative_motion import solve_motion
from trihedron.plugins.tracks.projection import Projection

START = pose_matrix(np.eye(3), np.zeros(3))


def pose(turn_deg, t=(0.0, 0.0, 0.0)):
    return pose_matrix(exp_so3(np.radians(np.array(turn_deg, float))), np.array(t, float))


def frame(room, index):
    return Frame(index, index * 33_000_000, np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32), room.camera)


def track(room, now, before, manhattan=(None, None), previous=None, **fields):
    return Projection(**fields)(frame(room, now[0].index).camera, *now, *before, *manhattan, previous, np.random.default_rng(0))


def right(now, before, tracks):
    """Share of the tracked key points whose descriptors say that they are the same."""
    i, j = tracks.keypoints.T
    return (now[0].descriptors[j] == before[0].descriptors[i]).all(axis=1).mean()


def test_finds_the_pairs_and_the_motion(room):
    world, rng = room(), np.random.default_rng(0)
    T = pose([0.5, -0.8, 0.3], [0.02, -0.01, 0.015])
    before, now = world.see(START, 0, rng), world.see(T, 1, rng)
    found = track(world, now, before)
    assert right(now, before, found) == 1.0 and len(found.keypoints) > 0.75 * 300 * 0.81  # each is seen in 90 % of the frames, some leave it
    assert np.array_equal(now[1].descriptors[found.segments[:, 1]], before[1].descriptors[found.segments[:, 0]]) and len(found.segments) > 25
    assert sorted(found.planes.tolist()) == [[0, 0], [1, 1], [2, 2]]
    assert np.array_equal(found.points_m, before[0].points_m[found.keypoints[:, 0]])
    assert np.array_equal(found.coefficients, before[2].coefficients)
    assert rotation_angle_deg(found.R_current_previous @ T[:3, :3]) < 0.1
    assert found.previous_index == 0


@pytest.mark.parametrize("missing", ["points", "lines", "walls", "points lines", "points walls"])
def test_any_kind_may_be_missing(room, missing):
    kinds = dict.fromkeys(missing.split(), False)
    world, rng = room(), np.random.default_rng(1)
    T = pose([0.5, -0.8, 0.3], [0.02, -0.01, 0.015])
    before, now = world.see(START, 0, rng, **kinds), world.see(T, 1, rng, **kinds)
    found = track(world, now, before)
    assert (len(found.keypoints) == 0) == (not kinds.get("points", True))
    assert (len(found.segments) == 0) == (not kinds.get("lines", True))
    assert (len(found.planes) == 0) == (not kinds.get("walls", True))
    assert rotation_angle_deg(found.R_current_previous @ T[:3, :3]) < 0.6


def test_nothing_at_all_and_first_frame_and_old_features(room):
    world, rng = room(), np.random.default_rng(2)
    nothing = {"points": False, "lines": False, "walls": False}
    full, empty = world.see(START, 1, rng), world.see(START, 0, rng, **nothing)
    for now, before in ((world.see(START, 1, rng, **nothing), empty), (full, empty), (world.see(START, 2, rng, **nothing), full)):
        found = track(world, now, before)
        assert len(found.keypoints) == len(found.segments) == len(found.planes) == 0
        assert np.allclose(found.R_current_previous, np.eye(3), atol=1e-6)
    assert track(world, full, (None, None, None)) is None
    assert len(track(world, world.see(START, 11, rng), full).keypoints) > 100
    assert len(track(world, world.see(START, 12, rng), full).keypoints) == 0


def test_turn_of_nine_degrees_needs_a_prediction_and_any_will_do(room):
    world, rng = room(), np.random.default_rng(3)
    T = pose([0.0, 9.0, 2.0], [0.02, 0.0, 0.01])
    before, now = world.see(START, 5, rng), world.see(T, 6, rng)
    manhattan = world.manhattan(T[:3, :3], 6, rng), world.manhattan(START[:3, :3], 5, rng)
    still = replace(track(world, before, world.see(START, 4, rng)), R_current_previous=np.eye(3))
    turning = replace(still, R_current_previous=T[:3, :3].T)
    blind = track(world, now, before, wide_below=0)
    guided = [track(world, now, before, manhattan), track(world, now, before, previous=turning), track(world, now, before, manhattan, still)]
    assert all(len(found.keypoints) > 1.2 * len(blind.keypoints) and right(now, before, found) == 1.0 for found in guided)
    assert all(rotation_angle_deg(found.R_current_previous @ T[:3, :3]) < 0.1 for found in guided)


@pytest.mark.parametrize("turn_deg", [20.0, 35.0])
def test_wide_baseline_is_matched_without_a_prediction(room, turn_deg):
    """A turn that moves every key point far out of the search radius: pairs by descriptors alone that agree on one rigid motion, or none."""
    world, rng = room(), np.random.default_rng(10)
    T = pose([0.0, turn_deg, 2.0], [0.15, 0.0, 0.1])
    before, now = world.see(START, 5, rng), world.see(T, 6, rng)
    near, wide = track(world, now, before, wide_below=0), track(world, now, before)
    assert len(wide.keypoints) > 50 > 3 * len(near.keypoints) and right(now, before, wide) == 1.0
    assert rotation_angle_deg(wide.R_current_previous @ T[:3, :3] @ START[:3, :3].T) < 0.3
    keypoints = now[0]
    shuffled = replace(keypoints, descriptors=rng.permutation(keypoints.descriptors))
    assert np.array_equal(track(world, (shuffled, *now[1:]), before).keypoints, track(world, (shuffled, *now[1:]), before, wide_below=0).keypoints)


def test_of_several_manhattan_frames_those_with_one_id_are_compared(room):
    world, rng = room(), np.random.default_rng(3)
    T, other = pose([0.0, 9.0, 2.0], [0.02, 0.0, 0.01]), exp_so3(np.radians([0.0, 30.0, 0.0]))
    nothing = world.see(T, 6, rng, points=False, lines=False, walls=False)
    before = world.see(START, 5, rng)

    def two(R, index, order, seen=(9, 9)):
        frames = [world.manhattan(R, index, rng, 0.01), world.manhattan(R, index, rng, 0.01, axes=other)]
        columns = {name: np.concatenate([getattr(frames[k], name) for k in order]) for name in ("rotations", "covariance", "spread")}
        inliers = np.repeat(np.array(seen, np.int32)[list(order), None], 3, axis=1)
        return replace(frames[0], **columns, inliers=inliers, ids=np.array(order, np.int32))

    def off_deg(now, then):
        return rotation_angle_deg(track(world, nothing, before, (now, then)).R_current_previous @ T[:3, :3])

    for order in ((0, 1), (1, 0)):  # the best supported comes first
        assert off_deg(two(T[:3, :3], 6, order), two(START[:3, :3], 5, (0, 1))) < 0.2
    out_of_sight = two(START[:3, :3], 5, (0, 1), seen=(0, 9))
    lied = replace(out_of_sight, rotations=out_of_sight.rotations[[1, 1]])
    assert off_deg(two(T[:3, :3], 6, (0, 1)), lied) < 0.2
    alone = two(T[:3, :3], 6, (0, 1), seen=(9, 0))
    assert off_deg(alone, lied) == pytest.approx(rotation_angle_deg(T[:3, :3]), abs=1e-3)  # none in common: no turn


def test_constant_velocity_is_scaled_to_the_gap(room):
    world, rng = room(), np.random.default_rng(4)
    step = exp_so3(np.radians([0.0, 2.0, 0.0]))
    before, now = world.see(START, 5, rng), world.see(pose_matrix(np.linalg.matrix_power(step.T, 3), np.zeros(3)), 8, rng)
    previous = replace(track(world, before, world.see(START, 4, rng)), R_current_previous=step)
    nothing = world.see(START, 8, rng, points=False, lines=False, walls=False)
    assert rotation_angle_deg(track(world, nothing, before, previous=previous).R_current_previous.T @ exp_so3(np.radians([0.0, 6.0, 0.0]))) < 1e-3
    assert len(track(world, now, before, previous=previous).keypoints) > 150


def test_wrong_pairs_and_moving_things_are_left_out(room):
    world, rng = room(), np.random.default_rng(5)
    T = pose([0.4, -0.5, 0.2], [0.01, -0.01, 0.02])
    before, now = world.see(START, 0, rng), world.see(T, 1, rng)
    moving = {tuple(d) for d in world.point_bits[:120]}  # 40 % of the points moved by 8 cm by themselves
    places, pixels = now[0].points_m.copy(), now[0].pixels.copy()
    rows = [k for k, d in enumerate(now[0].descriptors) if tuple(d) in moving]
    places[rows] += np.float32([0.08, 0.0, 0.0])
    pixels[rows] = world.camera.project(places[rows].astype(np.float64)).astype(np.float32)
    now = (replace(now[0], points_m=places, pixels=pixels), *now[1:])
    found = track(world, now, before)
    wrong = sum(tuple(d) in moving for d in now[0].descriptors[found.keypoints[:, 1]])
    assert wrong <= 2 and len(found.keypoints) > 100
    assert rotation_angle_deg(found.R_current_previous @ T[:3, :3]) < 0.15


def test_points_without_depth_in_one_of_the_frames(room):
    world, rng = room(), np.random.default_rng(6)
    T = pose([0.4, -0.5, 0.2], [0.01, -0.01, 0.02])
    before, now = world.see(START, 0, rng), world.see(T, 1, rng)
    far = before[0].points_m.copy()
    far[::2] = np.nan
    found = track(world, now, (replace(before[0], points_m=far), *before[1:]))
    assert np.isnan(found.points_m[:, 0]).sum() > 60 and right(now, before, found) == 1.0
    blind = replace(now[0], points_m=np.full_like(now[0].points_m, np.nan))
    neither = track(world, (blind, *now[1:]), (replace(before[0], points_m=far), *before[1:]))
    assert not np.isnan(neither.points_m).any() and len(neither.keypoints) > 60


@pytest.mark.parametrize("with_depth", [True, False])
def test_motion_covariance_is_realistic(room, with_depth):
    errors = []
    for seed in range(60):
        world, rng = room(seed), np.random.default_rng(seed)
        T = pose(rng.normal(0, 0.5, 3), rng.normal(0, 0.01, 3))
        kinds = [{}, {"points": False}, {"lines": False}][seed % 3]
        before, now = world.see(START, 0, rng, **kinds), world.see(T, 1, rng, depth=with_depth, **kinds)
        found = track(world, now, before)
        motion = solve_motion(Projection(angle_px=0.001, plane_floor_deg=0.01), world.camera, found, *now, 1)
        truth = invert(T)
        e = np.concatenate([_vector(truth[:3, :3] @ motion.R.T), truth[:3, 3] - motion.t])
        errors.append(e @ np.linalg.solve(motion.covariance, e) / 6.0)
    assert 0.2 < np.mean(errors) < 1.5


def _vector(R):
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


def test_frames_without_depth_continue_the_tracks(room):
    """Two of four frames: the motion to each is measured, and so is that to the frame whose depth is back, as well as from frame to frame."""
    world, rng = room(), np.random.default_rng(11)
    poses = [pose(np.multiply(i, [0.4, -0.5, 0.2]), np.multiply(i, [0.01, -0.01, 0.02])) for i in range(4)]
    seen = [world.see(T, i, rng, depth=i in (0, 3)) for i, T in enumerate(poses)]
    tracks = None
    for i in range(1, 4):
        tracks = track(world, seen[i], seen[i - 1], previous=tracks)
        true = invert(poses[i]) @ poses[i - 1]
        motion = solve_motion(Projection(), world.camera, tracks, *seen[i], 1)
        assert right(seen[i], seen[i - 1], tracks) == 1.0 and len(tracks.keypoints) > 120 and len(tracks.segments) > 15
        assert rotation_angle_deg(motion.R.T @ true[:3, :3]) < 0.1 and np.linalg.norm(motion.t - true[:3, 3]) < 0.006
    carried = np.isfinite(tracks.points_m[:, 2])
    shown = world.camera.back_project(seen[2][0].pixels[tracks.keypoints[:, 0]], tracks.points_m[:, 2])
    assert carried.sum() > 120 and np.allclose(tracks.points_m, shown, atol=1e-5, equal_nan=True)  # on the ray of the pixel
    assert (tracks.sigma_m[carried] > seen[0][0].sigma_m.min()).all()


def test_motion_without_terms_is_the_prediction_with_the_prior(room):
    none = Tracks(
        1, 1, 0, np.zeros((0, 2), np.int32), np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros((0, 2), np.int32),
        np.zeros((0, 2, 3), np.float32), np.zeros((0, 2), np.int32), np.zeros((0, 4)), np.zeros((0, 3, 3)), exp_so3(np.array([0.1, 0.0, 0.0])),
    )  # fmt: skip
    world, rng = room(), np.random.default_rng(7)
    motion = solve_motion(Projection(), world.camera, none, *world.see(START, 1, rng), 1)
    assert np.allclose(motion.R, exp_so3(np.array([0.1, 0.0, 0.0]))) and np.allclose(motion.t, 0.0) and motion.support == 0.0
    assert np.allclose(np.sqrt(np.diag(motion.covariance)), np.repeat([np.radians(2.0), 0.1], 3))


def test_the_share_of_key_points_that_repeat(room):
    """A frame against itself, of which so many key points have another pixel or descriptor; two frames of a camera that moves."""
    world, rng = room(), np.random.default_rng(9)
    before, next_one = world.see(START, 0, rng), world.see(pose([0.2, 0.5, 0.1], [0.01, 0.0, 0.0]), 1, rng)
    keypoints, *others = before
    pixels, descriptors = keypoints.pixels.copy(), keypoints.descriptors.copy()
    pixels[::4, 0] += 0.01
    descriptors[1::4, 0] ^= 1
    half = replace(keypoints, index=1, pixels=pixels, descriptors=descriptors)
    assert track(world, (half, *others), before).repeated == pytest.approx(0.5, abs=0.02)
    assert track(world, (replace(keypoints, index=1), *others), before).repeated == 1.0
    assert track(world, next_one, before).repeated == 0.0


def test_same_bytes_again(room):
    world, rng = room(0, points=1000, edges=100), np.random.default_rng(8)
    before, now = world.see(START, 0, rng), world.see(pose([0.2, 0.5, 0.1], [0.01, 0.0, 0.0]), 1, rng)
    first = track(world, now, before)
    again = track(world, now, before)
    assert first.keypoints.tobytes() == again.keypoints.tobytes() and first.R_current_previous.tobytes() == again.R_current_previous.tobytes()


@pytest.mark.parametrize("wrong", [{"near_px": 0.0}, {"ratio": 1.5}, {"line_deg": 0.0}, {"max_age": 0}])
def test_fields_out_of_range(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Projection(**wrong)
