"""Bundle adjustment of a room that is known: derivatives, the Schur complement, what is recovered and how well, windows with little in them."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, pose_matrix, tangent_basis
from trihedron.pipeline.core.lie import exp_se3, log_se3
from trihedron.pipeline.core.table import Table
from trihedron.plugins.bundle.colmap import Colmap, solve_colmap
from trihedron.plugins.bundle.local_window import LocalWindow, solve_bundle
from trihedron.plugins.bundle.local_window_kernels import (
    HUBER,
    PRIOR_LANDMARK,
    SQUARES,
    TRUNCATED,
    NormalEquations,
    add_damping,
    linearise_bundle,
    retract,
)
from trihedron.plugins.bundle.window import BundleOptions, WindowOptions, bundle_problem, bundle_window
from trihedron.plugins.mapping.correction import apply_correction
from trihedron.plugins.none import NoBundle

sys.path.insert(0, str(Path(__file__).parent))
from derivatives import numeric
from landmark_world import CAMERA, World, camera_at
from map_steps import EVERY, TABLES, correction, rows_of_world, step, walk

INTRINSICS = np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])


@pytest.fixture(scope="module")
def room():
    world = World(4000)
    return world, walk(world, 10, stride=4)


def disturbed(map, window, sigma=(0.01, 0.005), seed=0):
    """The map with its free keyframes off by 10 mm and 0.3°, as they were tracked."""
    rng = np.random.default_rng(seed)
    T = map.keyframes.rows("T_world_camera", window.free)
    T = np.stack([one @ exp_se3(rng.normal(size=6) * np.repeat(sigma, 3)) for one in T])
    covariance = np.broadcast_to(np.diag(np.repeat(np.square(sigma), 3)), (len(map.keyframes), 6, 6))
    keyframes = map.keyframes.updated(np.arange(len(map.keyframes)), covariance=covariance)
    return dataclasses.replace(map, keyframes=keyframes.updated(window.free, T_world_camera=T))


def small_problem(room, lines=6):
    """Few landmarks of every kind, so that dense algebra is quick, the points measured more than once: others are not in H and g."""
    _, map = room
    window = bundle_window(WindowOptions(4, 3), map)
    twice = window.points[np.diff(bundle_problem(BundleOptions(), map, window)[1].point_starts) > 1]
    window = dataclasses.replace(window, points=twice[:40], lines=window.lines[:lines])
    state, seen = bundle_problem(BundleOptions(), disturbed(map, window), window)
    return state, seen


def room_for(state, seen):
    c, n = 6 * seen.free + 3 * len(state.planes), len(state.points) + len(state.lines)
    o = len(seen.point_keyframes) + len(seen.line_keyframes)
    return NormalEquations(np.empty((c, c)), np.empty(c), np.empty((n, 4, 4)), np.empty((n, 4)), np.empty((o, 6, 4)))


@pytest.mark.parametrize("loss", [SQUARES, HUBER])
def test_the_gradient_is_that_of_the_cost(room, loss):
    """By poses, points and planes; without lines, whose points slide along them as they turn, which their derivatives leave out."""
    state, seen = small_problem(room, lines=0)
    out = room_for(state, seen)
    linearise_bundle(state, seen, loss, out)
    gradient, of_points = 2.0 * out.g, 2.0 * out.b[: len(state.points), :3]

    def cost(dx, steps):
        return np.array([linearise_bundle(retract(state, seen.free, dx, steps), seen, loss, room_for(state, seen))])

    steps = np.zeros((len(out.b), 4))
    found = numeric(lambda d: cost(d, steps), len(gradient))[0]
    assert np.allclose(found, gradient, rtol=1e-4, atol=1e-5 * np.abs(gradient).max())
    for row in (0, 7):
        found = numeric(lambda d, row=row: cost(np.zeros(len(gradient)), np.eye(len(steps))[row][:, None] * np.append(d, 0.0)), 3)[0]
        assert np.allclose(found, of_points[row], rtol=1e-4, atol=1e-4 * np.abs(of_points).max())


def dense(state, seen, out):
    """The whole Hessian, landmarks included, with the prior weights, and the gradient."""
    c, n = len(out.g), len(out.b)
    H = np.zeros((c + 4 * n, c + 4 * n))
    add_damping(out.H, seen.free, 0.0, H[:c, :c])
    points = np.repeat(np.arange(len(state.points)), np.diff(seen.point_starts))
    lines = len(state.points) + np.repeat(np.arange(len(state.lines)), np.diff(seen.line_starts))
    for o, (k, row) in enumerate(zip([*seen.point_keyframes, *seen.line_keyframes], [*points, *lines])):
        if k < seen.free:
            H[6 * k : 6 * k + 6, c + 4 * row : c + 4 * row + 4] += out.W[o]
    H[c:, :c] = H[:c, c:].T
    for row in range(n):
        V = np.tril(out.V[row]) + np.tril(out.V[row], -1).T
        H[c + 4 * row : c + 4 * row + 4, c + 4 * row : c + 4 * row + 4] = V + PRIOR_LANDMARK * np.eye(4)
    return H, np.concatenate([out.g, out.b.ravel()])


def test_the_schur_complement_gives_the_covariance_of_the_whole(room):
    state, seen = small_problem(room)
    found = solve_bundle(state, seen, 10)
    out = room_for(state, seen)
    assert linearise_bundle(found.state, seen, TRUNCATED, out) == pytest.approx(found.cost)
    H, gradient = dense(found.state, seen, out)
    covariance, c = np.linalg.inv(H), len(out.g)
    assert np.allclose(found.covariance, covariance[:c, :c], rtol=1e-6, atol=1e-12)
    for row in range(len(out.b)):
        block = slice(c + 4 * row, c + 4 * row + 4)
        assert np.allclose(found.landmark_covariance[row], covariance[block, block], rtol=1e-6, atol=1e-12)
    step = covariance @ gradient
    assert step @ H @ step < 0.1 * c  # at the minimum: what is left to go is small against the standard deviations


def test_a_point_measured_once_follows_its_keyframe_and_says_nothing_of_it(room):
    _, map = room
    window = bundle_window(WindowOptions(4, 3), map)
    map = disturbed(map, window)
    once = np.diff(bundle_problem(BundleOptions(), map, window)[1].point_starts) == 1
    others = dataclasses.replace(window, points=window.points[~once])
    _, seen = bundle_problem(BundleOptions(), map, window)
    found, without = (solve_bundle(*bundle_problem(BundleOptions(), map, points), 10) for points in (window, others))
    assert once.sum() > 10
    assert np.allclose(found.state.rotations, without.state.rotations, atol=1e-12)
    assert np.allclose(found.covariance, without.covariance, rtol=1e-9)
    k, pixels = (column[seen.point_starts[:-1][once]] for column in (seen.point_keyframes, seen.pixels))
    local = np.einsum("nij,ni->nj", found.state.rotations[k], found.state.points[once] - found.state.positions[k])
    assert np.allclose(CAMERA.project(local), pixels, atol=1e-2)


def errors_of(world, window, found):
    """Normalised squared errors of poses (per keyframe, 6 each), points (3 each) and planes (3 each)."""
    of_poses, of_planes, free = [], [], len(window.free)
    for i, k in enumerate(window.free):
        xi = log_se3(invert(camera_at(4 * k)) @ pose_matrix(found.state.rotations[i], found.state.positions[i]))
        of_poses.append(xi @ np.linalg.solve(found.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6], xi))
    for i, plane in enumerate(found.state.planes):
        truth = world.planes[np.abs(world.planes - plane).sum(axis=1).argmin()]
        delta = np.append(tangent_basis(plane[:3]).T @ truth[:3], truth[3] - plane[3])
        at = 6 * free + 3 * i
        of_planes.append(delta @ np.linalg.solve(found.covariance[at : at + 3, at : at + 3], delta))
    return np.array(of_poses), np.array(of_planes)


def test_a_disturbed_window_goes_back_to_the_truth_within_its_covariance():
    of_poses, of_planes, of_points = [], [], []
    for seed in range(4):
        world = World(4000, seed=seed)
        map = walk(world, 10, stride=4)
        window = bundle_window(WindowOptions(6, 4), map)
        state, seen = bundle_problem(BundleOptions(), disturbed(map, window, seed=seed), window)
        found = solve_bundle(state, seen, 15)
        assert found.cost < 0.6 * linearise_bundle(state, seen, TRUNCATED, room_for(state, seen)) and found.iterations < 20
        rows = len(seen.pixels) * 2 + np.isfinite(seen.depth_m).sum() + 4 * len(seen.endpoints_px) + 3 * len(seen.plane_landmarks)
        assert 0.6 * rows < found.cost < rows  # χ² of about one a residual, less what the unknowns and the gates take
        assert np.array_equal(found.state.rotations[seen.free :], state.rotations[seen.free :])
        assert np.array_equal(found.state.positions[seen.free :], state.positions[seen.free :])
        poses, planes = errors_of(world, window, found)
        of_poses.append(poses)
        of_planes.append(planes)
        error = found.state.points - world.position[rows_of_world(world, map)[window.points]]
        covariance = found.landmark_covariance[: len(error), :3, :3]
        of_points.append(np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0]))
    print(f"χ² of poses {np.mean(of_poses):.1f} (6), planes {np.mean(of_planes):.1f} (3), points {np.mean(np.concatenate(of_points)):.2f} (3)")
    assert 2.0 < np.mean(of_poses) < 12.0 and np.mean(of_planes) < 8.0
    assert 2.0 < np.mean(np.concatenate(of_points)) < 4.5


def test_the_map_takes_the_correction_and_is_nearer_to_the_truth(room):
    world, map = room
    window = bundle_window(WindowOptions(8, 8), map)
    off = disturbed(map, window)
    adjusted = apply_correction(off, LocalWindow()(off))
    for k in window.free:
        before, after = (
            np.linalg.norm(log_se3(invert(camera_at(4 * k)) @ one.keyframes.rows("T_world_camera", np.array([k]))[0])) for one in (off, adjusted)
        )
        assert after < 0.4 * before
    assert np.array_equal(adjusted.keyframes.rows("T_world_camera", window.fixed), map.keyframes.rows("T_world_camera", window.fixed))
    error = [one.points.rows("position_m", window.points) - world.position[rows_of_world(world, map)[window.points]] for one in (map, adjusted)]
    rmse = [np.sqrt((e**2).sum(axis=1).mean()) for e in error]
    assert rmse[1] < 1.1 * rmse[0]  # no worse than the filter that knew every pose
    chi2 = np.einsum("ni,nij,nj->n", error[1], adjusted.points.rows("information", window.points), error[1])
    assert 2.0 < chi2.mean() < 4.5


def test_the_first_keyframe_never_moves_and_one_keyframe_is_nothing_to_adjust(room):
    _, map = room
    window = bundle_window(WindowOptions(20, 20), map)
    assert 0 in window.fixed and 0 not in window.free and len(window.free) == 9
    window = bundle_window(WindowOptions(3, 0), map)  # nothing outside holds it, so its oldest does
    assert len(window.free) == 2 and len(window.fixed) == 1 and window.fixed[0] < window.free.min() and 9 in window.free
    assert not len(bundle_window(WindowOptions(8, 8), walk(World(300), 1)).free)
    assert LocalWindow()(walk(World(300), 1)) is None and NoBundle()(map) is None


def test_it_runs_once_a_keyframe(room):
    _, map = room
    assert LocalWindow()(map) is not None
    assert LocalWindow()(dataclasses.replace(map, index=map.index + 1)) is None  # as after its own correction


def without_kinds(map, *kinds):
    """The map with every landmark of some kinds dead."""
    dead = {kind: getattr(map, kind).updated(np.arange(len(getattr(map, kind))), alive=np.zeros(len(getattr(map, kind)), bool)) for kind in kinds}
    return dataclasses.replace(map, **dead)


@pytest.mark.parametrize("kinds", [("points",), ("points", "lines"), ("lines", "planes"), ("points", "lines", "planes")], ids="-".join)
def test_a_window_without_some_kinds_stays_sane(room, kinds):
    """What nothing measures stays; what planes alone measure (three walls: everything) is adjusted."""
    bare = without_kinds(room[1], *kinds)
    found = LocalWindow()(bare)
    if len(kinds) == 3:
        assert found is None
        return
    for k, T in zip(found.keyframe_ids, found.T_world_keyframe):
        assert np.linalg.norm(log_se3(invert(camera_at(4 * k)) @ T)) < 0.02
    for value in (found.points_m, found.point_information, found.endpoints_m, found.line_information, found.coefficients, found.plane_covariance):
        assert np.isfinite(value).all()


def test_what_is_said_is_what_the_map_then_holds(room):
    """Bit for bit, to a micrometre: the correction is rounded as the map's columns are, and so is what is recorded of both."""
    map = room[1]
    found = LocalWindow()(map)
    after = apply_correction(map, found)
    assert np.array_equal(after.points.rows("position_m", found.point_ids), found.points_m)
    assert np.array_equal(after.points.rows("information", found.point_ids), found.point_information)
    assert np.array_equal(after.lines.rows("endpoints_m", found.line_ids), found.endpoints_m)
    micrometres = found.points_m * 2.0**20
    assert len(micrometres) > 100 and np.array_equal(micrometres, np.rint(micrometres))


def test_two_walls_leave_the_motion_along_them_where_it_was(room):
    _, map = room
    bare = without_kinds(map, "points", "lines")
    bare = dataclasses.replace(bare, planes=bare.planes.updated(np.array([2]), alive=np.array([False])))
    window = bundle_window(WindowOptions(8, 8), bare)
    off = disturbed(bare, window)
    found = LocalWindow()(off)
    n = off.planes.rows("coefficients", window.planes)[:, :3]
    along = np.cross(n[0], n[1]) / np.linalg.norm(np.cross(n[0], n[1]))
    moved = found.T_world_keyframe[:, :3, 3] - off.keyframes.rows("T_world_camera", window.free)[:, :3, 3]
    assert np.abs(moved @ along).max() < 2e-3 < 4e-3 < np.linalg.norm(moved, axis=1).max()


def in_two_parts(map, later):
    """The map whose keyframes from `later` on share no point, line or plane with those before, except one wall, which the first two and the newest
    observed."""
    tables = {}
    for kind in ("points", "lines", "planes"):
        table = getattr(map, kind)
        observers = table.column("observers")
        both = (observers >= later).any(axis=1) & ((observers >= 0) & (observers < later)).any(axis=1)
        tables[kind] = table.updated(np.arange(len(table)), alive=table.column("alive") & ~both)
    wall = np.array([0])
    observers = np.full((1, map.planes.column("observers").shape[1]), -1, np.int32)
    observers[0, :3] = 0, 1, len(map.keyframes) - 1
    return dataclasses.replace(map, **{**tables, "planes": tables["planes"].updated(wall, alive=np.array([True]), observers=observers)})


def test_keyframes_that_a_wall_alone_connects_with_the_rest_stay_where_odometry_has_them(room):
    """The most covisible keyframes are then at the other end of the map: without the one before in time, 6 to 9 would slide along the wall."""
    map = in_two_parts(room[1], later=6)
    window = bundle_window(WindowOptions(6, 3), map)
    assert window.free.tolist() == [1, 6, 7, 8, 9] and 5 in window.fixed and len(window.fixed) == 4
    found = solve_bundle(*bundle_problem(BundleOptions(), disturbed(map, window), window), 10)
    variances = [found.covariance[6 * k : 6 * k + 3, 6 * k : 6 * k + 3] for k in range(len(window.free))]
    assert np.sqrt(np.linalg.eigvalsh(variances)[:, -1]).max() < 0.1


def test_the_cost_of_a_frame_does_not_depend_on_the_size_of_the_map(room, monkeypatch):
    """Matching, inserting a keyframe, adjusting and applying the correction read whole columns of keyframes, and of landmarks only who lives."""
    world, map = room
    read, column = [], Table.column
    monkeypatch.setattr(Table, "column", lambda table, name: (read.append((name, "T_world_camera" in table.schema)), column(table, name))[1])
    found = LocalWindow()(map)
    after = step(EVERY, world, map, 10, at=40, bundle=found)
    assert len(after.keyframes) == 11 and read and {name for name, of_keyframes in read if not of_keyframes} <= {"alive"}


def test_the_same_bytes_again(room):
    one, two = (LocalWindow()(room[1]) for _ in range(2))
    assert all(np.asarray(getattr(one, f.name)).tobytes() == np.asarray(getattr(two, f.name)).tobytes() for f in dataclasses.fields(one))


def test_culled_keyframes_move_with_the_living_one_nearest_to_them(room):
    _, map = room
    poses = map.keyframes.column("T_world_camera")
    poses[[5, 7]] = poses[[4, 6]] @ exp_se3(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0]))
    keyframes = map.keyframes.updated(np.array([5, 7]), alive=np.array([False, False]), T_world_camera=poses[[5, 7]])
    shift = exp_se3(np.array([0.1, -0.05, 0.02, 0.01, 0.03, -0.02]))
    moved = correction(map, keyframe_ids=np.array([8, 4], np.int32), T_world_keyframe=shift @ poses[[8, 4]])
    after = apply_correction(dataclasses.replace(map, keyframes=keyframes), moved)
    expected = [shift @ T if k in (4, 5, 8, 9) else T for k, T in enumerate(poses)]  # 5 as 4, 7 as 6, and 9 as the newest corrected
    assert np.allclose(after.keyframes.column("T_world_camera"), expected)


def points_only(room):
    """Pixels alone of points seen at least three times, from a disturbed state: what COLMAP adjusts."""
    _, map = room
    window = bundle_window(WindowOptions(6, 4), map, least_fixed=2)
    often = map.points.rows("found", window.points) >= 3
    none = np.empty(0, np.int32)
    window = dataclasses.replace(window, points=window.points[often], lines=none, planes=none)
    state, seen = bundle_problem(BundleOptions(), disturbed(map, window), window)
    unknown = np.zeros_like(seen.motion_information)
    return state, seen._replace(depth_m=np.full(len(seen.depth_m), np.nan), motion_information=unknown, robust=False)


def test_the_same_minimum_as_colmap(room):
    """Least squares of pixels alone: costs agree to 1e-5, poses to 0.5 mm and 0.01°."""
    state, seen = points_only(room)
    ours, theirs = solve_bundle(state, seen, 50), solve_colmap(state, seen, 100, 0.0)
    before, cost = (linearise_bundle(s, seen, SQUARES, room_for(s, seen)) for s in (state, theirs))
    print(f"cost {before:.1f} -> {ours.cost:.4f} ours, {cost:.4f} COLMAP's")
    assert ours.cost == pytest.approx(cost, rel=1e-5) and cost < 0.2 * before
    for k in range(seen.free):
        a, b = (pose_matrix(s.rotations[k], s.positions[k]) for s in (ours.state, theirs))
        xi = log_se3(invert(a) @ b)
        assert np.linalg.norm(xi[:3]) < 5e-4 and np.degrees(np.linalg.norm(xi[3:])) < 0.01


def test_colmap_as_a_stage(room):
    _, map = room
    window = bundle_window(WindowOptions(8, 8), map, least_fixed=2)
    off = disturbed(map, window)
    adjusted = apply_correction(off, Colmap()(off))
    before, after = (
        np.mean([np.linalg.norm(log_se3(invert(camera_at(4 * k)) @ one.keyframes.rows("T_world_camera", np.array([k]))[0])) for k in window.free])
        for one in (off, adjusted)
    )
    assert after < 0.5 * before
    assert Colmap()(walk(World(300), 2)) is None
    assert all(len(getattr(adjusted, name)) == len(getattr(map, name)) for name in TABLES)


@pytest.mark.parametrize("stage", [LocalWindow, Colmap])
@pytest.mark.parametrize("options", [{"keyframes": 0}, {"iterations": 0}, {"fixed": -1}])
def test_ranges_are_checked(stage, options):
    with pytest.raises(ValueError, match=f"^{next(iter(options))}: "):
        stage(**options)
