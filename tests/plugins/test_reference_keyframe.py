"""Corrections of the map while the camera is tracked: what was said before them follows the map without a jump."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hydra import compose, initialize_config_module

from trihedron.pipeline.core.config import graph_of, register_configs
from trihedron.pipeline.core.geometry import invert, pose_matrix, transform, transform_planes
from trihedron.pipeline.core.lie import adjoint, exp_se3, exp_so3, log_se3, rotation_angle_deg
from trihedron.pipeline.core.registry import load_plugins
from trihedron.pipeline.core.types import CALIBRATION, LOST, Correction, Map, Pose, Rotation
from trihedron.pipeline.record.trajectories import read_trajectory
from trihedron.pipeline.run.results import causal_trajectory, final_trajectory, write_results
from trihedron.pipeline.run.runner import Runner
from trihedron.plugins.mapping.landmarks import KEYFRAMES, empty_map
from trihedron.plugins.mapping.reference_keyframe import transform_rotation_to_map, transform_to_map, with_relative_sensitivity
from trihedron.plugins.shared.calibration_error import calibration_covariance
from trihedron.plugins.shared.covariances import transform_plane_covariance

SHIFT = pose_matrix(exp_so3(np.radians([3.0, 4.0, 0.0])), np.array([0.2, -0.1, 0.2]))  # 5° and 0.3 m


def map_with(*poses):
    n, empty = len(poses), np.zeros((len(poses), 2), np.int32)
    map = empty_map(0, 0, 32, 32, 8)
    keyframes, _ = map.keyframes.appended(
        index=np.arange(n), stamp_ns=np.arange(n), T_world_camera=np.array(poses), covariance=np.tile(np.eye(6), (n, 1, 1)),
        world_covariance=np.tile(np.eye(6), (n, 1, 1)), sensitivity=np.zeros((n, 6, CALIBRATION)), twist=np.zeros((n, 6)),
        aligned=np.zeros((n, 6)), undone=np.zeros((n, 6)), undone_sensitivity=np.zeros((n, 6, CALIBRATION)),
        intrinsics=np.ones((n, 4)), submap=np.zeros(n), points=empty, lines=empty, planes=empty, alive=np.ones(n, np.bool_),
    )  # fmt: skip
    assert set(KEYFRAMES) == set(keyframes.schema)
    return replace(map, keyframes=keyframes)


def pose_against(T_world_keyframe, T, reference=1):
    return Pose(7, 7, T, np.eye(6), invert(T_world_keyframe) @ T, reference, np.zeros(3, np.int32), 0, "ok", "")


def test_a_pose_follows_its_keyframe_and_is_untouched_otherwise():
    rng = np.random.default_rng(0)
    first, second, T = (exp_se3(rng.normal(size=6)) for _ in range(3))
    pose = pose_against(second, T)
    assert transform_to_map(pose, None) is pose
    assert transform_to_map(pose, map_with(first, second)) is pose  # not a rounding error away
    assert transform_to_map(pose, map_with(SHIFT @ first, second)) is pose
    moved = transform_to_map(pose, map_with(first, SHIFT @ second))
    assert np.allclose(moved.T_world_camera, SHIFT @ T, atol=1e-12)
    assert np.array_equal(moved.T_reference_camera, pose.T_reference_camera)
    unborn = replace(pose, reference=-1)
    assert transform_to_map(unborn, map_with(SHIFT @ first, second)) is unborn


def test_the_error_by_the_calibration_follows_the_keyframe():
    """A corrected keyframe errs less by the calibration, and so does a pose relative to it, by what both have in common."""
    rng = np.random.default_rng(0)
    keyframe, T = exp_se3(rng.normal(size=6)), exp_se3(rng.normal(size=6))
    of_keyframe, more = rng.normal(size=(6, CALIBRATION)), 0.1 * rng.normal(size=(6, CALIBRATION))

    def mapped(T_world_keyframe, sensitivity):
        map = map_with(T_world_keyframe)
        return replace(map, keyframes=map.keyframes.updated(np.zeros(1, np.int32), sensitivity=sensitivity[None]))

    before = mapped(keyframe, of_keyframe)
    pose = replace(pose_against(keyframe, T, reference=0), sensitivity=adjoint(invert(T) @ keyframe) @ of_keyframe + more)
    pose = with_relative_sensitivity(pose, before)
    assert pose.relative_sensitivity == pytest.approx(more)
    known = calibration_covariance(pose)
    pose = replace(pose, covariance=known + 2.0 * np.eye(6), map_covariance=known + np.eye(6))
    assert transform_to_map(pose, mapped(SHIFT @ keyframe, of_keyframe)).sensitivity == pytest.approx(pose.sensitivity)
    moved = transform_to_map(pose, mapped(SHIFT @ keyframe, np.zeros_like(of_keyframe)))
    assert moved.sensitivity == pytest.approx(more)
    assert moved.covariance - calibration_covariance(moved) == pytest.approx(2.0 * np.eye(6))
    assert moved.map_covariance - calibration_covariance(moved) == pytest.approx(np.eye(6))
    first = replace(pose, reference=-1)
    assert with_relative_sensitivity(first, before) is first


def test_rounding_does_not_grow_from_keyframe_to_keyframe():
    """A hundred keyframes, each the pose of a camera that follows the keyframe before, which a correction moves: the transpose as inverse doubles the
    rounding of a rotation each time."""
    rng, T = np.random.default_rng(0), exp_se3(np.ones(6))
    T[:3, :3] *= 1.0 + 1e-13
    for _ in range(100):
        pose = pose_against(T, T @ exp_se3(rng.normal(size=6)), reference=0)
        T = transform_to_map(pose, map_with(SHIFT @ T)).T_world_camera
    assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-11


def test_the_manhattan_frames_turn_with_the_camera():
    rng = np.random.default_rng(1)
    keyframe, T = exp_se3(rng.normal(size=6)), exp_se3(rng.normal(size=6))
    frames = np.array([exp_so3(rng.normal(size=3)) for _ in range(2)])
    rotation = Rotation(7, 7, T[:3, :3], np.eye(3), frames, frames, np.arange(2, dtype=np.int32), np.ones(2), "manhattan")
    pose = pose_against(keyframe, T, reference=0)
    assert transform_rotation_to_map(rotation, None, map_with(SHIFT @ keyframe)) == (rotation, None)
    same, said = transform_rotation_to_map(rotation, pose, map_with(keyframe))
    assert same is rotation and said is pose
    turned, now = transform_rotation_to_map(rotation, pose, map_with(SHIFT @ keyframe))
    assert np.allclose(now.T_world_camera, SHIFT @ T)
    before = np.swapaxes(rotation.R_world_camera.T @ frames, 1, 2)
    assert np.allclose(np.swapaxes(turned.R_world_camera.T @ turned.R_world_manhattan, 1, 2), before, atol=1e-12)
    assert np.allclose(turned.R_world_manhattan, SHIFT[:3, :3] @ frames)


@dataclass(frozen=True)
class Shove:
    """Moves the whole map by SHIFT, once, when it has its third keyframe."""

    shift: np.ndarray

    def __call__(self, map: Map) -> Correction | None:
        if len(map.keyframes) != 3 or map.keyframes.column("index")[-1] != map.index:
            return None
        R, planes = self.shift[:3, :3], transform_planes(self.shift, map.planes.column("coefficients"))
        turned = [(R @ table.column("information") @ R.T).astype(np.float32) for table in (map.points, map.lines)]
        ids = [np.arange(len(table), dtype=np.int32) for table in (map.keyframes, map.points, map.lines, map.planes)]
        return Correction(
            map.index, map.stamp_ns, map.revision, ids[0], self.shift @ map.keyframes.column("T_world_camera"),
            ids[1], transform(self.shift, map.points.column("position_m")), turned[0],
            ids[2], transform(self.shift, map.lines.column("endpoints_m")), turned[1], ids[3], planes,
            transform_plane_covariance(self.shift, map.planes.column("coefficients"), planes, map.planes.column("covariance")),
        )  # fmt: skip


def tracked(shift, *overrides, frames=40):
    load_plugins()
    register_configs()
    with initialize_config_module("trihedron.conf", version_base="1.3"):
        config = compose("root", ["dataset=synthetic", "dataset.width=320", "dataset.height=240", f"dataset.frames=0:{frames}", *overrides])
    graph = graph_of(config)
    stages = dict(graph.stages)
    bundle = stages["bundle"]
    stages["bundle"] = replace(bundle, plugin=Shove(shift)) if shift is not None else bundle
    runner = Runner(replace(graph, stages=stages), threads=2)
    rotations = [step.values["rotation"] for step in runner.steps(None, frozenset())]
    return runner.result, rotations


@pytest.fixture(scope="module")
def still():
    return tracked(np.eye(4))


@pytest.fixture(scope="module")
def shoved():
    return tracked(SHIFT)


def test_tracking_goes_on_in_the_moved_world(still, shoved):
    """The same camera in a map that was moved by 0.3 m and 5° half-way: every later pose is moved by as much, to a millimetre."""
    (result, rotations), (plain, plain_rotations) = shoved, still
    keyframes = result.map.keyframes
    applied = int(keyframes.column("index")[2]) + 5  # bundle@5: seen by the poses after this frame
    assert 10 < applied < 34 and all(pose.status != LOST for pose in result.poses)
    assert all(np.array_equal(a.T_world_camera, b.T_world_camera) for a, b in zip(result.poses[: applied + 1], plain.poses))
    later = zip(result.poses[applied + 1 :], plain.poses[applied + 1 :])
    off = np.array([log_se3(invert(SHIFT @ b.T_world_camera) @ a.T_world_camera) for a, b in later])
    assert np.linalg.norm(off[:, :3], axis=1).max() < 1e-3 and np.degrees(np.linalg.norm(off[:, 3:], axis=1)).max() < 0.05
    relative = [log_se3(invert(a.T_reference_camera) @ b.T_reference_camera) for a, b in zip(result.poses, plain.poses) if a.reference == b.reference]
    assert len(relative) == len(plain.poses) and np.abs(relative).max() < 1e-3
    for now, before, moved in zip(rotations, plain_rotations, np.arange(len(rotations)) > applied):
        expected = (SHIFT[:3, :3] if moved else np.eye(3)) @ before.R_world_manhattan[0]
        assert rotation_angle_deg(now.R_world_manhattan[0].T @ expected) < 0.02 and now.source == before.source


def test_the_final_trajectory_has_no_step(still, shoved):
    (result, _), (plain, _) = shoved, still
    for said, final in zip(causal_trajectory(plain).poses, final_trajectory(result).poses):
        assert np.abs(log_se3(invert(SHIFT @ said) @ final)).max() < 2e-3


def test_both_trajectories_are_written(shoved, tmp_path):
    result, _ = shoved
    write_results(tmp_path, result, final_trajectory(result), None)
    causal, final = (read_trajectory(tmp_path / name).poses for name in ("trajectory_causal.txt", "trajectory.txt"))
    assert np.allclose(causal, causal_trajectory(result).poses, atol=1e-6) and np.allclose(final, final_trajectory(result).poses, atol=1e-6)
    assert not np.allclose(causal, final, atol=0.1)
