"""Loops closed and refused in a room that is known, walked through by a camera whose place drifts."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.lie import exp_se3, log_se3
from trihedron.pipeline.core.types import Frame, Matches, Pose
from trihedron.plugins.loop.appearance import AppearanceLoop
from trihedron.plugins.loop.loop_closing import accept_loop, path_lengths, place_of
from trihedron.plugins.loop.planes import PlanesLoop
from trihedron.plugins.loop.storeys import climbs_m, on_storey_of_last
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.mapping.correction import apply_correction
from trihedron.plugins.mapping.covisibility_graph import observed_by
from trihedron.plugins.mapping.landmark_kinds import KINDS, LINE, POINT
from trihedron.plugins.matches.local_map import LocalMap
from trihedron.plugins.shared.pose_graph import Edges, edge_errors, elimination_order, remaining_errors, solve_pose_graph
from trihedron.plugins.shared.pose_optimizer import solve_pose
from trihedron.plugins.shared.residuals_kernels import PlaneTerms

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import CAMERA, INTO_CORNER, World, rotation_of, translation_of

STEPS = 40  # frames of the walk: 2.4 m out and back, ending where it began
DRIFT_M = np.array([0.25, -0.02, 0.15])  # at its end
UP, CLIMB_M = -INTO_CORNER[:3, 1], 3.0
OPTIONS = {"every": 1, "away_m": 2.0, "view_m": 0.5, "drift_share": 0.1}
LOOPS = {"planes": PlanesLoop(**OPTIONS), "appearance": AppearanceLoop(**OPTIONS)}


def true_pose(index):
    """Out and back by 1.2 m, and looking aside in the middle, so that the way back shows another part of the room."""
    share = index / (STEPS - 1)
    turn = exp_se3(np.array([0, 0, 0, 0, np.radians(50.0) * np.sin(np.pi * share), 0]))[:3, :3]
    return pose_matrix(turn, np.array([0.0, 0.0, 1.2 * np.sin(np.pi * share)]))


def drifted_pose(index):
    T = true_pose(index).copy()
    T[:3, 3] += DRIFT_M * index / (STEPS - 1)
    return T


def frame_at(world, index, depth_m=None):
    """The frame of a keyframe, with a depth image everywhere as given (0 = none) in the camera's own size."""
    depth = np.full((CAMERA.height, CAMERA.width), 0.0 if depth_m is None else depth_m, np.float32)
    return Frame(index, index * 33_000_000, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA)


def upstairs_pose(index):
    """From the middle of the walk on, a storey higher: upstairs looks the same to the last detail."""
    T = true_pose(index).copy()
    T[:3, 3] += CLIMB_M * UP * (index >= STEPS // 2)
    return T


def map_of_walk(pose_at):
    """The world and the map of a walk, tracked at the poses that `pose_at` returns; every frame is a keyframe."""
    world, map = World(points=2000), None
    stage = Covisibility(min_frames=1, max_frames=1, min_shift=1e-3)
    for index in range(STEPS):
        truth, T = true_pose(index), pose_at(index)
        features = world.features(truth, index)
        matches = LocalMap(near=0)(world.frame(index).camera, rotation_of(T, index), translation_of(T, index), *features, map, None)
        pose = Pose(index, index * 33_000_000, T, np.eye(6) * 1e-6, T, -1, np.zeros(3, np.int32), 0, "ok", "")
        map = stage(world.frame(index), pose, *features, matches, map, None, None, None) or map
    return world, map


@pytest.fixture(scope="module")
def walked():
    """The world and the map of a walk whose poses drift."""
    return map_of_walk(drifted_pose)


@pytest.fixture(scope="module")
def climbed():
    """The world and the map of a walk that goes on upstairs."""
    return map_of_walk(upstairs_pose)


@pytest.mark.parametrize("name", LOOPS)
def test_a_loop_is_closed_and_the_map_moves_with_it(walked, name):
    world, map = walked
    correction = LOOPS[name](map, frame_at(world, STEPS - 1))
    assert correction is not None and correction.based_on == map.revision
    moved = apply_correction(map, correction)
    T = moved.keyframes.column("T_world_camera")
    error = np.linalg.norm(T[:, :3, 3] - [true_pose(i)[:3, 3] for i in range(STEPS)], axis=1)
    assert np.linalg.norm(DRIFT_M) > 0.29 and error[-1] < 0.03 and error.max() < 0.1
    np.testing.assert_array_equal(T[0], map.keyframes.column("T_world_camera")[0])
    newest = [np.flatnonzero((getattr(map, kind).column("first") == STEPS - 1) & getattr(map, kind).column("alive")) for kind in ("points", "lines")]
    shift = moved.points.rows("position_m", newest[0]) - map.points.rows("position_m", newest[0])
    np.testing.assert_allclose(shift.mean(axis=0), -DRIFT_M, atol=0.03)
    ends = moved.lines.rows("endpoints_m", newest[1]) - map.lines.rows("endpoints_m", newest[1])
    assert not len(ends) or np.abs(ends.mean(axis=(0, 1)) + DRIFT_M).max() < 0.06
    again = LOOPS[name](map, frame_at(world, STEPS - 1))
    np.testing.assert_array_equal(again.T_world_keyframe, correction.T_world_keyframe)
    np.testing.assert_array_equal(again.coefficients, correction.coefficients)


@pytest.mark.parametrize("name", LOOPS)
def test_a_drift_that_cannot_be_is_refused(walked, name):
    """The same view, but 0.3 m away after 3 m with a drift of 1 %: another place that looks the same."""
    world, map = walked
    assert dataclasses.replace(LOOPS[name], drift_share=0.01)(map, frame_at(world, STEPS - 1)) is None


@pytest.mark.parametrize("name", LOOPS)
def test_another_storey_that_looks_the_same_is_refused(climbed, name, monkeypatch):
    """The drift may be as large as a storey is high, and all that is in view agrees."""
    world, map = climbed
    closer, frame = dataclasses.replace(LOOPS[name], drift_share=0.2, straighten=0), frame_at(world, STEPS - 1)
    assert closer(map, frame) is None
    monkeypatch.setattr("trihedron.plugins.loop.loop_closing.on_storey_of_last", lambda map, rows, share: np.ones(len(rows), np.bool_))
    correction = closer(map, frame)
    shift = correction.T_world_keyframe[-1, :3, 3] - map.keyframes.column("T_world_camera")[-1, :3, 3]
    np.testing.assert_allclose(shift, -CLIMB_M * UP, atol=0.1)


def test_stairs_are_a_climb_and_drift_is_none(climbed, walked):
    rows = np.arange(STEPS, dtype=np.int32)
    climb = climbs_m(climbed[1], rows, 0.01)
    np.testing.assert_allclose(climb, np.where(rows < STEPS // 2, 0.0, CLIMB_M), atol=0.1)
    np.testing.assert_array_equal(on_storey_of_last(climbed[1], rows, 0.01), rows >= STEPS // 2)
    assert on_storey_of_last(walked[1], rows, 0.01).all()


@pytest.mark.parametrize("name", LOOPS)
def test_what_the_camera_sees_through_is_not_there(walked, name):
    world, map = walked
    assert LOOPS[name](map, frame_at(world, STEPS - 1, 20.0)) is None


@pytest.mark.parametrize("name", LOOPS)
def test_nothing_to_do(walked, name):
    world, map = walked
    assert LOOPS[name](map, frame_at(world, STEPS)) is None  # this frame made no keyframe
    assert dataclasses.replace(LOOPS[name], away_m=50.0)(map, frame_at(world, STEPS - 1)) is None
    assert dataclasses.replace(LOOPS[name], every=2)(map, frame_at(world, STEPS - 1)) is None  # keyframe 39 is not looked at


@pytest.mark.parametrize(("normals", "accepted"), [(np.eye(3), True), (np.eye(3)[:2], False), (np.eye(3)[:1], False)])
def test_a_loop_that_leaves_a_direction_unobservable_is_refused(normals, accepted):
    """Thirty planes that agree within their noise: in a corridor they say nothing of the position along it."""
    planes = np.concatenate([np.tile(normals, (30 // len(normals), 1)), np.full((30, 1), 2.0)], axis=1)
    tight, prior = np.tile(np.eye(3) * 1e-6, (30, 1, 1)), np.diag(np.repeat([0.3**2, 0.02**2], 3))
    terms = PlaneTerms(np.zeros(30, np.int32), planes, tight, planes + np.array([0.0, 0.0, 0.0, 0.01]), tight)
    found = solve_pose(np.eye(4), CAMERA, np.eye(4), np.linalg.inv(prior), planes=terms)
    none, pairs = np.zeros((0, 2), np.int32), np.zeros((30, 2), np.int32)
    matches = Matches(0, 0, 0, none, none, pairs, none, none, none[:, 0], none[:, 0])
    assert found.planes.all() and accept_loop(PlanesLoop(), found, matches, prior, np.eye(4)) is accepted


def test_landmarks_that_recent_keyframes_observed_are_no_evidence_of_a_loop(walked):
    """Their positions have the drift that the loop would correct; the newest keyframe's own share with a place is counted."""
    _, map = walked
    rows, way = path_lengths(map)
    place, recent = place_of(LOOPS["planes"], map, 12, float(way[12])), rows[way <= 0.5 * OPTIONS["away_m"]]
    for kind, ids in zip(KINDS, (place.window.points, place.window.lines, place.window.planes)):
        there, since = observed_by(map, place.window.keyframes, kind), observed_by(map, recent, kind)
        assert len(np.intersect1d(there, since)) > 0
        assert set(ids.tolist()) == set(there.tolist()) - set(since.tolist())
    near = place_of(dataclasses.replace(LOOPS["planes"], away_m=0.02), map, STEPS - 6, float(way[STEPS - 6]))
    here = [observed_by(map, rows[-1:], kind) for kind in (POINT, LINE)]
    assert near.found == sum(np.isin(ids, observed_by(map, near.window.keyframes, kind)).sum() for ids, kind in zip(here, (POINT, LINE))) > 0


@pytest.mark.parametrize(("values", "field"), [({"every": 0}, "every"), ({"drift_share": 0.0}, "drift_share"), ({"view_deg": 120.0}, "view_deg")])
def test_ranges(values, field):
    for kind in (PlanesLoop, AppearanceLoop):
        with pytest.raises(ValueError, match=field):
            kind(**values)


def test_a_pose_graph_closes_a_circle():
    """One metre-step odometry with noise around 100 nodes; the closing edge is a hundred times better."""
    rng, n = np.random.default_rng(1), 100
    step = exp_se3(np.array([0.1, 0.0, 0.2, 0.0, 2 * np.pi / n, 0.0]))
    truth = [np.eye(4)]
    for _ in range(n - 1):
        truth.append(truth[-1] @ step)
    truth = np.array(truth)
    pairs = np.array([*((i, i + 1) for i in range(n - 1)), (0, n - 1)], np.int32)
    measured = invert(truth[pairs[:, 0]]) @ truth[pairs[:, 1]]
    sigma = np.array([0.003] * 3 + [0.002] * 3)
    measured[:-1] = [Z @ exp_se3(sigma * rng.standard_normal(6)) for Z in measured[:-1]]
    start = [np.eye(4)]
    for Z in measured[:-1]:
        start.append(start[-1] @ Z)
    information = np.tile(np.diag(sigma**-2), (n, 1, 1))
    information[-1] *= 1e4
    solved = solve_pose_graph(np.array(start), Edges(pairs, measured, information))
    before, after = (np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1) for poses in (np.array(start), solved))
    assert before[-1] > 0.08 and after[-1] < 1e-3 and after.max() < 0.7 * before.max()
    np.testing.assert_allclose(solved[:, :3, :3] @ np.swapaxes(solved[:, :3, :3], 1, 2), np.tile(np.eye(3), (n, 1, 1)), atol=1e-12)


def test_a_closed_circle_leaves_what_the_graph_cannot_tell_of_common_errors():
    """Poses that err by what grows round a circle, as do the odometry between them, but not the closing edge: what is left is linear in the error."""
    rng, n = np.random.default_rng(2), 30
    truth = np.array([exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 2.0 * np.pi * i / n, 0.0])) for i in range(n)])
    truth[:, :3, 3] = truth[:, :3, 2]
    errors = rng.normal(size=(6, 2))[None] * (np.arange(n) / n)[:, None, None] ** 1.5
    errors[-1, :, 1] = 0.0  # and one that cancels where the circle closes
    start = np.array([T @ exp_se3(1e-4 * xi) for T, xi in zip(truth, errors[:, :, 0])])
    pairs = np.array([*((i, i + 1) for i in range(n - 1)), *((i, i + 2) for i in range(n - 2)), (0, n - 1)], np.int32)
    measured = invert(start[pairs[:, 0]]) @ start[pairs[:, 1]]
    measured[-1] = invert(truth[0]) @ truth[-1]
    edges = Edges(pairs, measured, np.tile(np.diag([1e5] * 3 + [1e6] * 3), (len(pairs), 1, 1)) * rng.uniform(0.5, 2.0, len(pairs))[:, None, None])
    closing = (np.arange(len(pairs)) == len(pairs) - 1)[:, None, None]
    left = remaining_errors(start, edges, errors, closing * edge_errors(start, edges, errors))
    solved = np.array([log_se3(invert(T) @ S) for T, S in zip(truth, solve_pose_graph(start, edges))])
    assert left[:, :, 0] == pytest.approx(1e4 * solved, abs=2e-3 * np.abs(errors).max())
    assert np.linalg.norm(left[-1, :, 0]) < 0.2 * np.linalg.norm(errors[-1, :, 0])
    assert left[:, :, 1] == pytest.approx(errors[:, :, 1], abs=1e-9)
    assert remaining_errors(start, edges, errors, np.zeros((len(pairs), 6, 2))) == pytest.approx(errors)


def test_a_node_that_all_others_are_connected_to_does_not_widen_the_factor():
    """A chain of 400 nodes in any order, each linked to three, and one that all of them measure: it is last, and the factor of the rest narrow."""
    count, rng = 400, np.random.default_rng(3)
    near = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) <= 3
    H = np.ones((count + 1, count + 1), np.int32)
    H[:count, :count] = near
    shuffled = rng.permutation(count + 1)
    order = elimination_order(csr_matrix(H[shuffled][:, shuffled]))
    assert np.array_equal(np.sort(order), np.arange(count + 1)) and shuffled[order[-1]] == count
    ordered = H[shuffled[order]][:, shuffled[order]][:count, :count]
    assert (np.arange(count) - ordered.argmax(axis=1)).max() <= 6
