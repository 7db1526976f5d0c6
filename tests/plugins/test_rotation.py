"""Rotation tied to the Manhattan frame: drift, names of the axes, fallback, other frames, degenerate input."""

from dataclasses import replace

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.lie import exp_so3, log_so3, rotation_angle_deg
from trihedron.pipeline.core.types import LOST, OK, Frame, Pose
from trihedron.plugins.rotation.constant_velocity import ConstantVelocity
from trihedron.plugins.rotation.drift_free import DriftFree
from trihedron.plugins.rotation.known_frames import KnownFrames
from trihedron.plugins.rotation.procrustes import Procrustes
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent
from trihedron.plugins.tracks.projection import Projection


def wobble(index):
    """(4, 4) pose of a hand-held camera at frame `index`; the identity at 0."""
    a = index * 0.08
    turn = exp_so3(np.radians([4 * np.sin(a), 6 * np.sin(0.7 * a), 3 * np.sin(1.3 * a)]))
    return pose_matrix(turn, np.array([0.1 * np.sin(0.9 * a), 0.05 * np.sin(a), 0.0]))


def swing(index):
    """(4, 4) pose of a camera whose turn changes by about 2° a frame."""
    a = index * 0.5
    return pose_matrix(exp_so3(np.radians([4.0 * np.sin(a), 5.0 * np.sin(0.8 * a), 4.0 * np.cos(a) - 4.0])), np.zeros(3))


def said(T, index, rotation_covariance=None, status=OK):
    covariance = np.eye(6) * 1e-6
    covariance[3:, 3:] = np.eye(3) * np.radians(0.05) ** 2 if rotation_covariance is None else rotation_covariance
    return Pose(index, index * 33_000_000, T, covariance, T, -1, np.zeros(3, np.int32), 0, status, "")


class Run:
    """A room filmed frame by frame; `step` returns the rotation of the next frame."""

    def __init__(self, room, seed=0, plugin=None, path=wobble, **kinds):
        axes = exp_so3(np.random.default_rng(seed + 100).normal(0, 1, 3))
        self.world, self.rng, self.path, self.kinds = room(seed, axes=axes), np.random.default_rng(seed), path, kinds
        self.plugin, self.track = DriftFree() if plugin is None else plugin, Projection()
        self.index, self.before, self.tracks, self.previous, self.pose = -1, (None, None, None), None, None, None

    def step(self, manhattan=True, tracked=True, **how):
        self.index += 1
        T, i = self.path(self.index), self.index
        now = self.world.see(T, i, self.rng, **self.kinds)
        frame = Frame(i, i * 33_000_000, np.zeros((2, 2, 3), np.uint8), np.zeros((2, 2), np.float32), self.world.camera)
        rng = np.random.default_rng(self.index)
        self.tracks = self.track(frame.camera, *now, *self.before, None, None, self.tracks, rng) if tracked else None
        given = {"manhattan": self.world.manhattan(T[:3, :3], i, self.rng, **how) if manhattan else None, "tracks": self.tracks}
        given |= {
            "camera": self.world.camera,
            "keypoints": now[0],
            "segments": now[1],
            "planes": now[2],
            "previous": self.previous,
            "previous_pose": self.pose,
            "map": None,
        }
        wanted = type(self.plugin).__call__.__annotations__
        self.previous = self.plugin(**{name: value for name, value in given.items() if name in wanted})
        R = self.previous.R_world_camera
        assert np.allclose(R.T @ R, np.eye(3), atol=1e-12) and np.linalg.det(R) > 0.0
        assert np.all(np.linalg.eigvalsh(self.previous.covariance) > -1e-15)
        self.before = now
        self.pose = said(pose_matrix(R, T[:3, 3]), i, self.previous.covariance)  # not refined
        return self.previous

    def error_deg(self):
        return rotation_angle_deg(self.previous.R_world_camera.T @ self.path(self.index)[:3, :3])

    def axes_error_deg(self, row=0):
        R = self.previous.R_world_manhattan[row]
        return rotation_angle_deg(R.T @ nearest_equivalent(self.world.axes, R))


def test_first_frame_is_the_world_and_eq_1_holds(room):
    run = Run(room)
    first = run.step()
    assert np.array_equal(first.R_world_camera, np.eye(3)) and not first.covariance.any() and list(first.ids) == [0]
    assert np.allclose(first.R_world_manhattan[0], first.R_camera_manhattan[0])
    run.step(tracked=False)
    R = run.previous
    assert R.source == "manhattan" and rotation_angle_deg(R.R_world_camera.T @ R.R_world_manhattan[0] @ R.R_camera_manhattan[0].T) < 0.2


def test_does_not_drift_where_the_tracks_do(room):
    free, chained = [], []
    for seed in range(3):
        for plugin, errors in ((DriftFree(), free), (Procrustes(), chained)):
            run = Run(room, seed, plugin, share=0.3, lines=False, walls=False)  # other points in each frame
            errors.append([run.step() and run.error_deg() for _ in range(250)])
    rms = [[np.sqrt(np.mean(np.square(np.array(e)[:, part]))) for part in (slice(10, 60), slice(200, 250))] for e in (free, chained)]
    assert rms[0][1] < 0.7 and rms[0][1] < 1.3 * rms[0][0]  # the first frame's axes are known to 0.5°, and that is what stays
    assert rms[1][1] > 1.5 * rms[0][1]


def test_covariance_is_realistic(room):
    squares = []
    for seed in range(4):
        run = Run(room, seed)
        for _ in range(60):
            run.step()
            if run.index > 10:
                phi = log_so3(run.previous.R_world_camera.T @ run.path(run.index)[:3, :3])
                squares.append(phi @ np.linalg.solve(run.previous.covariance, phi) / 3.0)
    assert 0.1 < np.mean(squares) < 2.0


@pytest.mark.parametrize("plugin", [Procrustes(), ConstantVelocity()])
def test_covariance_without_a_manhattan_frame_is_realistic(room, plugin):
    """From a pose that is known, where the tracks say the turn and where nothing does: the error in units of the covariance."""
    for kinds, least in (({}, 0.003), ({"points": False, "lines": False, "walls": False}, 0.1)):
        squares = []
        for seed in range(3):
            run = Run(room, seed, plugin, path=swing, **kinds)
            for k in range(40):
                run.pose = said(run.path(k - 1), k - 1) if k else None
                run.step(manhattan=False)
                if k > 2:
                    phi = log_so3(run.previous.R_world_camera.T @ run.path(k)[:3, :3])
                    squares.append(phi @ np.linalg.solve(run.previous.covariance, phi) / 3.0)
        print(type(plugin).__name__, kinds, np.mean(squares))
        assert least < np.mean(squares) < 1.5


def test_names_of_the_axes_do_not_matter(room):
    run = Run(room, 1)
    for k in range(60):
        run.step(turn=k % 24)
        assert run.error_deg() < 1.0
    assert list(run.previous.ids) == [0] and run.previous.weights[0] > 50


def test_turn_of_120_degrees_without_tracks(room):
    run = Run(room, 2, path=lambda i: pose_matrix(exp_so3(np.radians([0.0, 2.0 * i, 0.0])), np.zeros(3)))
    for k in range(61):
        run.step(tracked=False, turn=(5 * k) % 24)
    assert run.error_deg() < 1.0 and run.previous.source == "manhattan" and list(run.previous.ids) == [0]


def test_tracks_carry_on_and_hand_back_without_a_jump(room):
    run = Run(room, 3)
    for _ in range(20):
        run.step()
    sigma = []
    for _ in range(40):
        assert run.step(manhattan=True, supported=False).source == "tracks"
        sigma.append(np.sqrt(np.trace(run.previous.covariance)))
        assert run.error_deg() < 1.0
    assert np.all(np.diff(sigma) > 0.0)
    for _ in range(20):
        before, error = run.previous.R_world_camera, run.path(run.index)[:3, :3]
        assert run.step().source == "manhattan"
        turned = error.T @ run.path(run.index)[:3, :3]
        assert rotation_angle_deg((before @ turned).T @ run.previous.R_world_camera) < 0.5 + 0.2
    assert run.error_deg() < 0.6 and list(run.previous.ids) == [0]


def test_another_manhattan_frame_gets_its_own_number_and_does_not_drag(room):
    run = Run(room, 4)
    for _ in range(20):
        run.step()
    slanted = exp_so3(np.radians([0.0, 12.0, 0.0])) @ run.world.axes
    for k in range(30):
        assert run.step(axes=slanted).source == ("tracks" if k == 0 else "manhattan")
        assert run.error_deg() < 1.0
    assert list(run.previous.ids) == [0, 1] and np.isnan(run.previous.R_camera_manhattan[0]).all()
    between = run.previous.R_world_manhattan[0].T @ run.previous.R_world_manhattan[1]
    angles = np.degrees(np.arccos(np.clip(np.abs(between).max(axis=0), -1.0, 1.0)))
    assert 11.0 < np.max(angles) < 13.0  # the axes that turned, whatever their names
    for _ in range(10):
        run.step()
    assert np.isnan(run.previous.R_camera_manhattan[1]).all() and np.isfinite(run.previous.R_camera_manhattan[0]).all()
    assert list(run.previous.ids) == [0, 1] and run.error_deg() < 1.0


def test_one_wrong_sighting_is_ignored_and_forgotten(room):
    run = Run(room, 5)
    for _ in range(10):
        run.step()
    wrong = exp_so3(np.radians([0.0, 0.0, 20.0])) @ run.world.axes
    assert run.step(axes=wrong).source == "tracks" and run.error_deg() < 1.0
    run.step()
    assert list(run.previous.ids) == [0] and run.previous.source == "manhattan"


def test_nothing_at_all_keeps_on_turning_and_says_prediction(room):
    run = Run(room, 6, path=lambda i: np.eye(4), points=False, lines=False, walls=False)
    first, second, third = (run.step(manhattan=False) for _ in range(3))
    assert second.source == third.source == "prediction" and np.array_equal(third.R_world_camera, np.eye(3))
    assert 0.0 == np.trace(first.covariance) < np.trace(second.covariance) < np.trace(third.covariance)
    turn = exp_so3(np.radians([0.0, 3.0, 0.0]))
    turning = replace(run.tracks, index=3, previous_index=2, R_current_previous=turn)
    for plugin in (DriftFree(), ConstantVelocity(), Procrustes()):
        given = {"tracks": turning, "keypoints": replace(run.before[0], index=3), "previous": third, "previous_pose": None, "map": None}
        if not isinstance(plugin, ConstantVelocity):
            given |= {"camera": run.world.camera, "segments": run.before[1], "planes": run.before[2]}
        found = plugin(**given, **({"manhattan": None} if isinstance(plugin, DriftFree) else {}))
        assert found.source == "prediction" and rotation_angle_deg(found.R_world_camera @ turn) < 1e-6


def test_builds_on_the_refined_pose_unless_it_is_lost_or_old(room):
    for status, index, used in ((OK, 5, True), (LOST, 5, False), (OK, 4, False)):
        run = Run(room, 7)
        for _ in range(6):
            run.step()
        better = pose_matrix(run.path(5)[:3, :3] @ exp_so3(np.radians([0.0, 5.0, 0.0])), np.zeros(3))
        run.pose = said(better, index, status=status)
        run.step(manhattan=False)
        assert (run.error_deg() > 4.0) == used


def test_world_axes_are_learnt_from_refined_poses(room):
    run = Run(room, 8)
    run.step(sigma_deg=1.0)
    for k in range(120):
        run.pose = said(run.path(k), k)
        run.step(sigma_deg=0.5)
    assert run.axes_error_deg() < 0.2 and 50 < run.previous.weights[0] <= 121


def test_garbage_gives_a_rotation(room):
    rng = np.random.default_rng(9)
    run = Run(room, 9)
    for _ in range(3):
        run.step()
    for k in range(30):
        run.step(manhattan=k % 3 > 0, sigma_deg=40.0, tracked=k % 2 > 0)  # axes that jump about
        i = run.index
        points = run.before[0].points_m + rng.normal(0, 5.0, run.before[0].points_m.shape).astype(np.float32)
        points[rng.random(len(points)) < 0.3] = np.nan
        run.before = (replace(run.before[0], points_m=points), *run.before[1:])
        run.pose = said(run.path(i), i) if k % 5 else None
    assert len(run.previous.ids) <= 6


@pytest.mark.parametrize(
    "plugin,wrong",
    [
        (DriftFree, {"unit_deg": 0.0}),
        (DriftFree, {"max_weight": 0.0}),
        (DriftFree, {"step_deg": -1.0}),
        (Procrustes, {"prior_m": 0.0}),
        (ConstantVelocity, {"prior_deg": 0.0}),
    ],
)
def test_fields_out_of_range(plugin, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        plugin(**wrong)


def test_a_frame_carried_on_out_of_sight_is_no_sighting(room):
    """Estimators of several frames remember those out of sight, without inliers: they must not confirm themselves."""
    run = Run(room, 4)
    known = run.step()
    seen = run.world.manhattan(run.path(0)[:3, :3], 0, run.rng)
    other = seen.rotations @ exp_so3(np.radians([0.0, 0.0, 30.0]))
    both = replace(
        seen,
        rotations=np.concatenate([other, seen.rotations]),
        ids=np.array([1, 0], np.int32),
        covariance=np.tile(seen.covariance, (2, 1, 1)),
        inliers=np.array([[0, 0, 0], [9, 0, 9]], np.int32),
        spread=np.array([[np.nan] * 3, [0.05, np.nan, 0.05]]),
    )
    frames = KnownFrames(known.R_world_manhattan, known.ids, known.weights)
    assert [row for row, _ in frames.associations(both, known.R_world_camera)] == [1]
