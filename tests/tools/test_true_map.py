"""The map with true keyframe poses: known motions of its keyframes move its landmarks, and nothing else changes."""

import numpy as np
import pytest

from trihedron.comparison.error_budget import dependent_stages, rewrite, true_poses
from trihedron.comparison.true_map import true_map
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.geometry import pose_matrix, rotation_from_quaternion
from trihedron.pipeline.core.linalg import matmul
from trihedron.pipeline.core.types import Map
from trihedron.pipeline.record.reader import Recording
from trihedron.plugins.mapping.correction import transform_landmarks

TABLES = ("keyframes", "points", "lines", "planes", "point_observations", "line_observations", "plane_observations")
MICROMETRE = 2e-6  # positions are stored in steps of one


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A run of a small room."""
    out = tmp_path_factory.mktemp("run")
    words = ["dataset.length=16", "dataset.width=320", "dataset.height=240", "map.min_shift=0.01", "map.min_turn_deg=1", "threads=1"]
    assert main(["run", *words, f"out={out}"]) == 0
    return Recording(out / "run.mcap")


@pytest.fixture(scope="module")
def last(recording):
    """The last map of the run."""
    return list(recording.values("map"))[-1]


def keyframe_poses(map: Map, *motions):
    """Stamp -> pose of each keyframe after its motion (4, 4) from the left, the last one given also for those that follow."""
    stamps, T = map.keyframes.column("stamp_ns").tolist(), map.keyframes.column("T_world_camera")
    return {stamp: matmul(motions[min(row, len(motions) - 1)], T[row]) for row, stamp in enumerate(stamps)}


def living(map: Map, kind: str, name: str):
    table = getattr(map, kind)
    return table.column(name)[table.column("alive")]


def test_true_poses_equal_to_the_estimate_leave_the_map_as_it_is(last):
    same = true_map(last, keyframe_poses(last, np.eye(4)))
    for kind, names in {"points": "position_m information", "lines": "endpoints_m", "planes": "coefficients covariance moments"}.items():
        for name in names.split():
            np.testing.assert_allclose(living(same, kind, name), living(last, kind, name), rtol=1e-5, atol=1e-9, err_msg=name)


def test_one_motion_of_all_keyframes_moves_the_whole_map_rigidly(last):
    T = pose_matrix(rotation_from_quaternion(np.array([0.1, -0.2, 0.3, 0.9]) / np.sqrt(0.95)), np.array([0.5, -1.0, 2.0]))
    moved = true_map(last, keyframe_poses(last, T))
    rows = [np.flatnonzero(getattr(last, kind).column("alive")).astype(np.int32) for kind in ("points", "lines", "planes")]
    expected = transform_landmarks(last, T, np.arange(len(last.keyframes), dtype=np.int32), *rows)
    np.testing.assert_allclose(moved.keyframes.column("T_world_camera"), expected.keyframes.column("T_world_camera"), atol=1e-12)
    np.testing.assert_allclose(living(moved, "points", "position_m"), living(expected, "points", "position_m"), atol=MICROMETRE)
    np.testing.assert_allclose(living(moved, "lines", "endpoints_m"), living(expected, "lines", "endpoints_m"), atol=MICROMETRE)
    largest = np.abs(living(expected, "points", "information")).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(living(moved, "points", "information") / largest, living(expected, "points", "information") / largest, atol=1e-5)
    normals = matmul(living(last, "planes", "coefficients")[:, :3], T[:3, :3].T)
    np.testing.assert_allclose(living(moved, "planes", "coefficients")[:, :3], normals, atol=1e-9)
    np.testing.assert_allclose(living(moved, "planes", "coefficients"), living(expected, "planes", "coefficients"), atol=1e-9)


def test_a_landmark_moves_by_the_mean_of_its_keyframes(last):
    shifts = [pose_matrix(np.eye(3), np.array([0.01 * row, 0.0, 0.0])) for row in range(len(last.keyframes))]
    assert len(shifts) > 1
    moved = true_map(last, keyframe_poses(last, *shifts))
    observers = living(last, "points", "observers")
    expected = [0.01 * np.mean(row[row >= 0]) for row in observers]
    found = living(moved, "points", "position_m") - living(last, "points", "position_m")
    np.testing.assert_allclose(found[:, 0], expected, atol=MICROMETRE)
    np.testing.assert_allclose(found[:, 1:], 0.0, atol=MICROMETRE)


def test_a_keyframe_without_truth_moves_with_the_nearest_in_time(last):
    T = pose_matrix(np.eye(3), np.array([0.0, 0.3, 0.0]))
    poses = keyframe_poses(last, T)
    first = int(last.keyframes.row("stamp_ns", 0))
    moved = true_map(last, {stamp: pose for stamp, pose in poses.items() if stamp == first})
    np.testing.assert_allclose(moved.keyframes.column("T_world_camera"), np.array(list(poses.values())), atol=1e-12)
    assert true_map(last, {}) is last


def test_every_version_of_the_true_map_has_the_recorded_rows(recording, tmp_path):
    """What later topics name is in the same row: rows, their life, ids in observations, and revisions are those of the recording."""
    truth = true_poses(recording)
    rewrite(recording, tmp_path / "true.mcap", {"map": truth.map})
    pairs = list(zip(recording.values("map"), Recording(tmp_path / "true.mcap").values("map"), strict=True))
    assert len(pairs) > 1
    for own, true in pairs:
        assert (own.index, own.stamp_ns, own.revision, own.loop_closed) == (true.index, true.stamp_ns, true.revision, true.loop_closed)
        for name in TABLES:
            before, after = getattr(own, name), getattr(true, name)
            assert len(before) == len(after), name
            for column in {"alive", "first", "observers", "descriptor", "index", "keyframe", "point", "line", "plane"} & set(before.schema):
                np.testing.assert_array_equal(before.column(column), after.column(column), err_msg=f"{name}.{column}")
        stamps = true.keyframes.column("stamp_ns").tolist()
        np.testing.assert_allclose(true.keyframes.column("T_world_camera"), [truth.poses[stamp] for stamp in stamps], atol=1e-9)


def test_a_known_drift_is_removed(last):
    """Keyframes that drift by 17 mm and 0.05° each take their landmarks along; with the poses from before the drift the map is as before."""
    half = np.radians(0.025)
    step = pose_matrix(rotation_from_quaternion(np.array([0.0, np.sin(half), 0.0, np.cos(half)])), np.array([0.01, 0.01, 0.01]))
    drift = [np.eye(4)]
    while len(drift) < len(last.keyframes):
        drift.append(matmul(step, drift[-1]))
    drifted = true_map(last, keyframe_poses(last, *drift))
    back = true_map(drifted, keyframe_poses(last, np.eye(4)))
    for kind, name in (("points", "position_m"), ("lines", "endpoints_m"), ("planes", "coefficients")):
        before, apart, after = (living(map, kind, name) for map in (last, drifted, back))
        assert np.abs(apart - before).max() > 0.01, kind
        np.testing.assert_allclose(after, before, atol=2e-4, err_msg=kind)


def test_what_depends_on_a_true_stage_is_computed_again(recording):
    """A true map is given, so what corrects it is not computed; poses feed back into rotation and translation, which are."""
    after_map = dependent_stages(recording, ("map",))
    assert {"rotation", "translation", "matches", "pose"} <= set(after_map) and not {"map", "bundle", "loop"} & set(after_map)
    assert {"map", "bundle", "matches", "pose", "translation"} <= set(dependent_stages(recording, ("rotation",)))
    assert not {"keypoints", "planes", "normals"} & set(dependent_stages(recording, ()))
