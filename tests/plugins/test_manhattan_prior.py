"""The Manhattan prior: a corridor whose map has drifted in rotation, aligned by the directions of its walls."""

import dataclasses

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, pose_matrix, transform_planes
from trihedron.pipeline.core.lie import adjoint, exp_se3, exp_so3, log_se3, log_so3
from trihedron.pipeline.core.types import CALIBRATION, Camera, Frame, Pose
from trihedron.plugins.loop import manhattan_prior
from trihedron.plugins.loop.appearance import AppearanceLoop
from trihedron.plugins.loop.keyframe_correction import correct_keyframes
from trihedron.plugins.loop.manhattan_prior import correct_loop, estimate_manhattan_prior
from trihedron.plugins.loop.planes import PlanesLoop
from trihedron.plugins.mapping import plane_fusion
from trihedron.plugins.mapping.correction import apply_correction
from trihedron.plugins.mapping.covisibility_graph import revisits
from trihedron.plugins.mapping.insertion import add_keyframe
from trihedron.plugins.mapping.landmarks import OBSERVERS, empty_map
from trihedron.plugins.shared.pose_optimizer import PoseSolution

CAMERA = Camera(640, 480, 525.0, 520.0, 319.5, 239.5)
KEYFRAMES, STEP_M = 64, 0.5
AXES = exp_so3(np.array([0.3, -0.4, 0.1]))  # R_world_manhattan
DRIFT = np.radians([0.1, 0.7, -0.2])  # at the end of the walk
EXACT = np.zeros((6, CALIBRATION))  # a loop that the calibration does not touch


def corridor(drift, axes=(0, 1, 2), turned=0.0, wall_deg=0.1, back=False):
    """A map of keyframes along a corridor, with `back` there and back, whose rotations drift, each with three new walls that are true to `wall_deg`;
    those of the second half stand on axes `turned` (rad) from the others. Returns the map and the rotations as they should be."""
    rng, map = np.random.default_rng(0), empty_map(0, 0, 32, 32, 4)
    covariance = np.tile(np.diag([1e-7, 1e-7, 1e-6]), (3, 1, 1))
    look, wing = exp_so3(np.array([0.0, 0.3, 0.0])), AXES @ exp_so3(np.array([turned, 0.0, 0.0]))
    for i in range(KEYFRAMES):
        far = STEP_M * (min(i, KEYFRAMES - 1 - i) if back else i)
        T = pose_matrix(exp_so3(drift * i / (KEYFRAMES - 1)) @ look if i else look, np.array([0.0, 0.0, far]))
        pose = Pose(i, i * 33_000_000, T, np.eye(6) * 1e-8, T, -1, np.zeros(3, np.int32), 0, "ok", "")
        map, row = add_keyframe(map, pose, CAMERA)
        normals = (AXES if i < KEYFRAMES / 2 else wing)[:, list(axes)].T
        normals = np.array([exp_so3(np.radians(wall_deg) * rng.normal(size=3)) @ n for n in normals])
        normals *= np.where(normals @ np.array([0.0, 0.0, 1.0]) > 0.0, -1.0, 1.0)[:, None]
        local = np.concatenate([normals @ look, np.full((3, 1), 2.0)], axis=1)  # as the camera sees them where it truly is
        table, _ = map.planes.appended(
            coefficients=transform_planes(T, local),
            covariance=covariance,
            moments=plane_fusion.move_moments(T, plane_fusion.equivalent_moments(local, covariance)),
            samples_m=np.zeros((3, 4, 3), np.float32),
            first=np.full(3, row),
            observers=np.tile(np.r_[row, np.full(OBSERVERS - 1, -1)], (3, 1)),
            found=np.ones(3, np.int32),
            visible=np.ones(3, np.int32),
            alive=np.ones(3, np.bool_),
        )
        map = dataclasses.replace(map, planes=table, index=i, stamp_ns=i * 33_000_000)
    return map, look


def with_shared_points(map, visits):
    """The map with new points, of which each of `visits` names how many and the keyframes that observed them."""
    seen = [[] for _ in range(len(map.keyframes))]
    for count, keyframes in visits:
        table, ids = map.points.appended(
            position_m=np.zeros((count, 3)),
            information=np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)),
            descriptor=np.zeros((count, 32), np.uint8),
            direction=np.zeros((count, 3), np.float32),
            distance_m=np.ones(count, np.float32),
            octave=np.zeros(count, np.uint8),
            first=np.full(count, keyframes[0]),
            observers=np.tile(np.r_[keyframes[::-1], np.full(OBSERVERS - len(keyframes), -1)], (count, 1)),
            found=np.ones(count, np.int32),
            visible=np.ones(count, np.int32),
            alive=np.ones(count, np.bool_),
        )
        map = dataclasses.replace(map, points=table)
        for keyframe in keyframes:
            seen[keyframe].extend(ids)
    for keyframe, ids in enumerate(seen):
        begin, one = len(map.point_observations), np.ones(len(ids), np.float32)
        table, _ = map.point_observations.appended(
            keyframe=np.full(len(ids), keyframe), point=np.array(ids, np.int32), pixel=np.zeros((len(ids), 2), np.float32), depth_m=one,
            sigma_px=one, sigma_m=one,
        )  # fmt: skip
        spans = np.array([[begin, begin + len(ids)]], np.int32)
        map = dataclasses.replace(map, point_observations=table, keyframes=map.keyframes.updated(np.array([keyframe]), points=spans))
    return map


def with_sensitivity(map, turns, parameter=0):
    """The map whose keyframes an error of one σ of a parameter turns by `turns` (k, 3), in their own frames."""
    sensitivity = np.zeros((KEYFRAMES, 6, CALIBRATION))
    sensitivity[:, 3:, parameter] = turns
    return dataclasses.replace(map, keyframes=map.keyframes.updated(np.arange(KEYFRAMES), sensitivity=sensitivity))


def frame():
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    return Frame(KEYFRAMES - 1, (KEYFRAMES - 1) * 33_000_000, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA)


def errors_deg(rotations, truth):
    return np.degrees([np.linalg.norm(log_so3(R @ truth.T)) for R in rotations])


def test_the_prior_rotations_are_the_drift():
    map, truth = corridor(DRIFT)
    prior = estimate_manhattan_prior(map, CAMERA)
    turned = np.array([log_so3(R @ exp_so3(phi) @ truth.T) for R, phi in zip(map.keyframes.column("T_world_camera")[:, :3, :3], prior.rotations)])
    common = turned.mean(axis=0)  # the axes themselves are found in the middle of the drift
    assert np.degrees(np.linalg.norm(turned - common, axis=1).max()) < 0.5 and np.degrees(np.linalg.norm(common)) < 0.6
    sigma = np.degrees(1.0 / np.sqrt(np.linalg.eigvalsh(prior.information)))
    assert sigma.min() > 0.15 and sigma.max() < 0.5  # three walls, true to 0.3° by assumption


@pytest.mark.parametrize("loop", [PlanesLoop(), AppearanceLoop()])
def test_a_drifted_map_is_aligned_with_its_manhattan_frame(loop):
    map, truth = corridor(DRIFT)
    correction = loop(map, frame())
    moved = apply_correction(map, correction)
    before, after = (errors_deg(m.keyframes.column("T_world_camera")[:, :3, :3], truth) for m in (map, moved))
    print(f"rotation off by {before.max():.3f}° at most, {after.max():.3f}° when straight")
    assert before.max() > 0.7 and after.max() < before.max() / 3.0
    np.testing.assert_array_equal(moved.keyframes.column("T_world_camera")[0], map.keyframes.column("T_world_camera")[0])
    normals = moved.planes.column("coefficients")[:, :3]
    assert np.degrees(np.arccos(np.abs(normals @ AXES).max(axis=1))).max() < 0.6  # walls turned with their keyframes
    np.testing.assert_array_equal(loop(map, frame()).T_world_keyframe, correction.T_world_keyframe)


def test_no_alignment_without_need():
    assert PlanesLoop()(corridor(np.zeros(3))[0], frame()) is None  # it is straight
    map, _ = corridor(DRIFT)
    assert PlanesLoop(straighten=0)(map, frame()) is None
    assert PlanesLoop(straighten=48)(map, frame()) is None  # keyframe 64 is none of its


def test_no_alignment_without_a_manhattan_frame():
    assert estimate_manhattan_prior(corridor(DRIFT, axes=(0, 0, 0))[0], CAMERA) is None  # one direction alone
    assert estimate_manhattan_prior(corridor(DRIFT, wall_deg=20.0)[0], CAMERA) is None  # walls every way
    assert PlanesLoop()(corridor(np.zeros(3), turned=np.radians(10.0))[0], frame()) is None  # the second half is another wing
    assert PlanesLoop()(corridor(np.zeros(3), turned=np.radians(3.0))[0], frame()) is None


def test_a_turn_that_the_calibration_explains_is_undone_though_it_is_no_drift():
    """The map turns by 3°, six times its plausible drift: left alone, unless a wrong calibration would have turned it alike."""
    map, truth = corridor(np.radians([0.0, 3.0, 0.0]))
    assert PlanesLoop()(map, frame()) is None
    turns = np.array([log_so3(R.T @ truth) / 1.5 for R in map.keyframes.column("T_world_camera")[:, :3, :3]])  # as an error of 1.5 σ
    explained = with_sensitivity(map, turns)
    moved = apply_correction(explained, PlanesLoop()(explained, frame()))
    assert errors_deg(moved.keyframes.column("T_world_camera")[:, :3, :3], truth).max() < 0.5
    left = moved.keyframes.column("sensitivity")[:, 3:, 0]
    assert np.linalg.norm(left[-1]) < 0.2 * np.linalg.norm(turns[-1])
    np.testing.assert_array_equal(moved.keyframes.column("T_world_camera")[0], map.keyframes.column("T_world_camera")[0])


def test_what_was_undone_before_counts_and_is_not_undone_again():
    """The first half was aligned before, by half of its error by the calibration, and what is left of that counts as nearly nothing: the directions,
    as they would be without that alignment, show the whole error, and the rest is undone."""
    map, truth = corridor(np.radians([0.0, 3.0, 0.0]))
    R = map.keyframes.column("T_world_camera")[:, :3, :3]
    turns = np.array([log_so3(one.T @ truth) / 1.5 for one in R])
    raw = with_sensitivity(map, turns)
    before, sensitivity = raw.keyframes.columns_at(np.arange(KEYFRAMES), "T_world_camera", "sensitivity")
    last = KEYFRAMES // 2
    undone, taken = np.zeros((KEYFRAMES, 6)), 0.95 * sensitivity
    undone[:, 3:] = 0.75 * turns
    after = before @ np.array([pose_matrix(exp_so3(xi), np.zeros(3)) for xi in undone[:, 3:]])
    after[last:] = after[last] @ invert(before[last]) @ before[last:]  # the second half follows the last of the first
    to_later = adjoint(invert(before[last:]) @ before[last])
    undone[last:], taken[last:] = to_later @ undone[last], to_later @ taken[last]
    columns = {"sensitivity": sensitivity - taken, "aligned": undone, "undone": undone, "undone_sensitivity": taken}
    every = np.arange(KEYFRAMES, dtype=np.int32)
    moved = apply_correction(raw, dataclasses.replace(correct_keyframes(raw, every, before, after), **columns))
    aligned = PlanesLoop()(moved, frame())
    assert errors_deg(moved.keyframes.column("T_world_camera")[:, :3, :3], truth).max() > 1.4
    assert errors_deg(aligned.T_world_keyframe[:, :3, :3], truth).max() < 0.5
    assert aligned.undone[:, 3:] == pytest.approx(1.5 * turns, abs=np.radians(0.3))
    assert aligned.undone_sensitivity + aligned.sensitivity == pytest.approx(raw.keyframes.column("sensitivity"), abs=1e-4)
    without = aligned.T_world_keyframe @ np.array([exp_se3(-xi) for xi in aligned.aligned])
    assert errors_deg(without[:, :3, :3], truth) == pytest.approx(errors_deg(R, truth), abs=1e-6)
    assert PlanesLoop()(apply_correction(moved, aligned), frame()) is None  # nothing is left to be undone


def test_walls_are_looked_for_where_the_known_calibration_has_moved_them():
    """The map turns by 20° on its way, too far for two axes to have walls, as a calibration would turn it that an alignment before has found."""
    map, truth = corridor(np.radians([0.0, 20.0, 0.0]), axes=(0, 2, 0))
    turns = np.array([log_so3(R.T @ truth) / 1.5 for R in map.keyframes.column("T_world_camera")[:, :3, :3]])
    map = with_sensitivity(map, turns)
    assert PlanesLoop()(map, frame()) is None
    known = dataclasses.replace(map, calibration_errors=1.4 * np.eye(CALIBRATION)[0])
    aligned = PlanesLoop()(known, frame())
    assert errors_deg(aligned.T_world_keyframe[:, :3, :3], truth).max() < 0.5
    assert aligned.calibration_errors == pytest.approx(1.5 * np.eye(CALIBRATION)[0], abs=0.05)
    assert np.array_equal(apply_correction(known, aligned).calibration_errors, aligned.calibration_errors)


def test_keyframes_that_drifted_beyond_the_reach_of_an_axis_are_aligned_with_those_before():
    """The map turns by 8° on its way, so that walls at its ends are off all axes by more than 2°, and a calibration would have turned it alike."""
    map, truth = corridor(np.radians([0.0, 8.0, 0.0]))
    drift = np.array([log_so3(R.T @ truth) for R in map.keyframes.column("T_world_camera")[:, :3, :3]])
    map = with_sensitivity(map, drift / 1.5)
    moved = apply_correction(map, PlanesLoop()(map, frame()))
    before, after = (errors_deg(m.keyframes.column("T_world_camera")[:, :3, :3], truth) for m in (map, moved))
    print(f"rotation off by {before.max():.3f}° at most, {after.max():.3f}° when straight")
    assert before.max() > 7.9 and after.max() < 0.1


def test_a_pass_that_reaches_another_wing_is_not_taken(monkeypatch):
    """The second half stands on axes 2° off, of which the first pass reaches few walls, the next all: no drift would turn it so far."""
    map, _ = corridor(DRIFT, turned=np.radians(2.0))
    aligned = PlanesLoop()(map, frame())
    monkeypatch.setattr(manhattan_prior, "PASSES", 1)
    np.testing.assert_array_equal(aligned.T_world_keyframe, PlanesLoop()(map, frame()).T_world_keyframe)


def test_a_loop_corrects_keyframes_as_they_would_be_without_alignment():
    """A map that was aligned, and the same one that was not: closed by the same loop, what the first would be without that is the second."""
    raw, _ = corridor(DRIFT)
    every = np.arange(KEYFRAMES, dtype=np.int32)
    before = raw.keyframes.column("T_world_camera")
    undone = np.zeros((KEYFRAMES, 6))
    undone[:, 1], undone[:, 5] = 0.02 * np.linspace(0.0, 1.0, KEYFRAMES) ** 2, np.radians(0.3) * np.linspace(0.0, 1.0, KEYFRAMES)
    columns = {"aligned": undone, "undone": undone, "undone_sensitivity": np.zeros((KEYFRAMES, 6, CALIBRATION))}
    columns["undone_sensitivity"][:, :, 2] = undone / 1.5
    moved = before @ np.array([exp_se3(xi) for xi in undone])
    aligned = apply_correction(raw, dataclasses.replace(correct_keyframes(raw, every, before, moved), **columns))
    T, none = before[-1] @ exp_se3(np.array([0.03, -0.05, 0.02, 0.003, 0.004, -0.005])), np.empty(0, np.uint8)
    found = PoseSolution(T, 1e-8 * np.eye(6), np.empty((6, 0)), none, none, none, 0.0)
    closed, expected = (correct_loop(PlanesLoop(), map, 0, found, EXACT, None) for map in (aligned, raw))
    without = closed.T_world_keyframe @ np.array([exp_se3(-xi) for xi in closed.aligned])
    assert np.abs(invert(moved) @ closed.T_world_keyframe - np.eye(4)).max() > 0.03
    assert without == pytest.approx(expected.T_world_keyframe, abs=5e-4)
    assert closed.undone == pytest.approx(1.5 * (closed.sensitivity + closed.undone_sensitivity)[:, :, 2], abs=1e-9)
    assert np.abs(closed.undone[-1]).max() < 1e-3 * np.abs(undone[-1]).max()
    assert expected.aligned == pytest.approx(0.0, abs=1e-12) and not expected.undone.any()


def test_a_closed_loop_leaves_no_error_of_the_calibration_where_it_closes():
    """The newest keyframe errs by 0.3 m and 2° for each σ of a parameter, those between in proportion; a loop finds where it is."""
    map, _ = corridor(np.zeros(3))
    sensitivity = np.zeros((KEYFRAMES, 6, CALIBRATION))
    sensitivity[:, 0, 3], sensitivity[:, 4, 3] = (np.linspace(0.0, size, KEYFRAMES) for size in (0.3, np.radians(2.0)))
    map = dataclasses.replace(map, keyframes=map.keyframes.updated(np.arange(KEYFRAMES), sensitivity=sensitivity))
    T, none = map.keyframes.row("T_world_camera", KEYFRAMES - 1), np.empty(0, np.uint8)
    found = PoseSolution(T, 1e-8 * np.eye(6), np.empty((6, 0)), none, none, none, 0.0)
    left = correct_loop(PlanesLoop(), map, 0, found, EXACT, None).sensitivity
    before = np.linalg.norm(sensitivity[:, :, 3], axis=1)
    assert left.shape == sensitivity.shape and not np.delete(left, 3, axis=2).any()
    after = np.linalg.norm(left[:, :, 3], axis=1)
    assert after[-1] < 0.01 * before[-1] and after[0] == 0.0 and after.max() < before[-1]
    assert left[-1] == pytest.approx(0.0, abs=1e-3)


def closing(map, motion=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)):
    """A loop that finds the newest keyframe where the map has it, but for a motion."""
    T, none = map.keyframes.row("T_world_camera", KEYFRAMES - 1) @ exp_se3(np.array(motion)), np.empty(0, np.uint8)
    return PoseSolution(T, 1e-8 * np.eye(6), np.empty((6, 0)), none, none, none, 0.0)


def test_a_loop_leaves_its_own_error_of_the_calibration():
    """The keyframes err by 0.3 m at the end, the loop by 2 mm: so does then the newest keyframe, and a loop that errs by 0.2 m moves it by little."""
    map, _ = corridor(np.zeros(3))
    sensitivity = np.zeros((KEYFRAMES, 6, CALIBRATION))
    sensitivity[:, 0, 3] = np.linspace(0.0, 0.3, KEYFRAMES)
    map = dataclasses.replace(map, keyframes=map.keyframes.updated(np.arange(KEYFRAMES), sensitivity=sensitivity))
    error = EXACT.copy()
    error[0, 3] = 0.002
    left = correct_loop(PlanesLoop(), map, 0, closing(map), error, None).sensitivity[-1]
    assert left[:, 3] == pytest.approx([0.002, 0.0, 0.0, 0.0, 0.0, 0.0], abs=6e-4)
    motion = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    before = map.keyframes.row("T_world_camera", KEYFRAMES - 1)
    for size, share in ((0.0, 1.0), (1.0, 0.0)):
        moved = correct_loop(PlanesLoop(), map, 0, closing(map, motion), 100.0 * size * error, None).T_world_keyframe[-1]
        assert log_se3(invert(before) @ moved)[0] == pytest.approx(0.1 * share, abs=0.02)


def test_what_is_known_of_the_calibration_is_undone_in_a_loop():
    """A loop that errs by an error of the calibration that the last alignment has found closes as an exact one would, and what the keyframes would be
    without alignment as it was measured."""
    map, _ = corridor(np.zeros(3))
    error, found = EXACT.copy(), np.zeros(CALIBRATION)
    error[:, 2], found[2] = [0.01, 0.0, 0.005, 0.0, np.radians(0.1), 0.0], 1.5
    known = dataclasses.replace(map, calibration_errors=found)
    measured = closing(map, -1.5 * error[:, 2])  # where undoing the error brings it to the map's pose
    corrected, plain = correct_loop(PlanesLoop(), known, 0, measured, error, None), correct_loop(PlanesLoop(), map, 0, measured, error, None)
    before = map.keyframes.column("T_world_camera")
    assert np.abs(invert(before) @ corrected.T_world_keyframe - np.eye(4)).max() < 1e-6
    without = corrected.T_world_keyframe @ np.array([exp_se3(-xi) for xi in corrected.aligned])
    assert without == pytest.approx(plain.T_world_keyframe, abs=1e-6)
    assert np.abs(invert(before) @ without - np.eye(4))[-1].max() > 0.01
    errors = corrected.sensitivity + corrected.undone_sensitivity
    assert corrected.undone[-1] == pytest.approx(1.5 * errors[-1, :, 2], abs=1e-6)


def test_visits_are_told_apart_by_what_keyframes_share():
    """Keyframes 10 to 13 share points with each other, 40 and 41 came back to them and 60 to both; 13 and 17 share too few."""
    shared = [(30, (10, 11, 12, 13)), (20, (11, 40)), (10, (11, 12, 40, 41)), (40, (12, 41, 60)), (29, (13, 17))]
    map, rows = with_shared_points(corridor(np.zeros(3))[0], shared), np.arange(KEYFRAMES, dtype=np.int32)
    assert revisits(map, rows, 30, 3).tolist() == [[11, 40], [12, 41], [12, 60], [41, 60]]
    assert revisits(map, rows, 29, 3).tolist() == [[13, 17], [11, 40], [12, 41], [12, 60], [41, 60]]
    assert revisits(map, rows, 30, 20).tolist() == [[11, 40], [12, 41], [12, 60]]  # from 41 to 60 there are 18
    assert revisits(map, rows[12:], 30, 3).tolist() == [[0, 29], [0, 48], [29, 48]]
    assert revisits(map, rows[:2], 30, 3).shape == (0, 2)


def test_an_alignment_does_not_open_a_loop_that_was_closed():
    """A corridor there and back, whose walls turn the keyframes, so that its ends move; two that share points stay where they saw each other."""
    map, _ = corridor(DRIFT, back=True)
    first, last, opened = 2, KEYFRAMES - 3, {}
    for name, known in (("without", map), ("with", with_shared_points(map, [(60, (first, last))]))):
        poses = apply_correction(known, PlanesLoop()(known, frame())).keyframes.column("T_world_camera")
        before = map.keyframes.column("T_world_camera")
        opened[name] = np.linalg.norm(log_se3(invert(invert(before[first]) @ before[last]) @ invert(poses[first]) @ poses[last])[:3])
    print(f"the loop is opened by {1000 * opened['without']:.0f} mm, with points that both share by {1000 * opened['with']:.0f} mm")
    assert opened["without"] > 0.05 and opened["with"] < 0.1 * opened["without"]
