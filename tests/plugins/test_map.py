"""The co-visibility map of a room that is known: what it keeps, how it converges, what it forgets, how it is corrected."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, tangent_basis, transform, transform_planes
from trihedron.pipeline.core.lie import exp_se3
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.mapping import plane_fusion
from trihedron.plugins.mapping.landmark_kernels import fuse_lines
from trihedron.plugins.mapping.landmark_kinds import landmarks_of, observations_of
from trihedron.plugins.matches.local_map import LocalMap
from trihedron.plugins.none import NoMap

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import World, camera_at, rotation_of, translation_of
from map_steps import EVERY, TABLES, pose_of, rows_of_world, step, walk


def test_the_first_frame_makes_a_keyframe_of_everything_with_depth():
    world = World()
    keypoints, segments, planes = world.features(np.eye(4), 0)
    map = step(Covisibility(), world, None, 0)
    with_depth = np.isfinite(keypoints.points_m).all(axis=1)
    assert map.revision == 1 and len(map.keyframes) == 1
    assert np.allclose(map.points.column("position_m"), keypoints.points_m[with_depth], atol=1e-6)
    assert np.array_equal(map.points.column("descriptor"), keypoints.descriptors[with_depth])
    assert len(map.lines) == np.isfinite(segments.endpoints_m).all(axis=(1, 2)).sum() > 0
    assert np.allclose(map.planes.column("coefficients"), planes.coefficients, atol=1e-6)
    for kind, landmarks in landmarks_of(map).items():
        table = observations_of(map)[kind]
        assert np.array_equal(table.column(kind.id_column), np.arange(len(landmarks))) and not table.column("keyframe").any()
        assert list(map.keyframes.column(kind.span_column)[0]) == [0, len(landmarks)]
        assert (landmarks.column("observers")[:, 0] == 0).all() and (landmarks.column("observers")[:, 1:] == -1).all()


def test_nothing_is_returned_when_nothing_changes():
    world = World()
    map = step(Covisibility(), world, None, 0)
    seen = dict(inliers=(60, 10, 3))
    assert step(Covisibility(), world, map, 1, at=0.3, **seen) is None  # 6 mm on
    assert step(Covisibility(), world, map, 1, at=20, **seen) is None  # too soon after the last keyframe
    assert step(Covisibility(), world, map, 9, at=20, status="lost", **seen) is None
    assert step(Covisibility(), world, map, 200, at=0.0, **seen) is None  # a camera at rest
    assert step(Covisibility(), world, map, 9, at=20, repeats=1, **seen) is None  # an image that repeats the one before
    assert step(Covisibility(), world, map, 9, at=20, scale_difference=0.02, **seen) is None  # depth has another scale than the map
    assert step(Covisibility(), world, map, 9, at=20, turn_difference=np.deg2rad([0.0, 0.3, 0.0]), **seen) is None  # planes turned otherwise
    assert step(Covisibility(), world, map, 9, at=20, plane_offsets=np.array([0.02, 0.005, 60]), **seen) is None  # planes lie elsewhere
    assert NoMap()(pose_of(np.eye(4), 0)) is None


@pytest.mark.parametrize("at, inliers, why", [(12, (60, 10, 3), "the view has changed"), (0.2, (5, 0, 1), "little of the last keyframe was found")])
def test_a_keyframe_is_made_when(at, inliers, why):
    world = World()
    map = step(Covisibility(), world, None, 0)
    after = step(Covisibility(), world, map, 9, at=at, inliers=inliers)
    assert after is not None and len(after.keyframes) == 2 and after.revision == 2, why


@pytest.mark.parametrize("inliers, sigma_m", [((5, 0, 0), 1e-5), ((12, 0, 1), 0.1)])
def test_a_keyframe_is_made_at_once_where_landmarks_run_out(inliers, sigma_m):
    """Frames far apart: three frames later nothing of the newest keyframe would be in view, also where the pose is in doubt."""
    world = World()
    map = step(Covisibility(), world, None, 0)
    pose = dataclasses.replace(pose_of(camera_at(20), 1, inliers=inliers), covariance=sigma_m**2 * np.eye(6), reference=0)
    features, frame = world.features(camera_at(20), 1), world.frame(1)
    matches = LocalMap()(frame.camera, rotation_of(camera_at(20), 1), translation_of(camera_at(20), 1), *features, map, None)
    after = Covisibility()(frame, pose, *features, matches, map, None, None, None)
    assert after is not None and len(after.keyframes) == 2


@pytest.mark.parametrize("index, hz, made", [(1, 30.0, False), (2, 30.0, False), (3, 30.0, True), (1, 10.0, True), (5, 60.0, False), (6, 60.0, True)])
def test_the_time_since_the_last_keyframe_counts_whatever_the_rate(index, hz, made):
    """A tenth of a second: three frames at 30 images a second, one at 10."""
    world = World()
    map = step(Covisibility(), world, None, 0)
    frame = dataclasses.replace(world.frame(index), stamp_ns=round(1e9 * index / hz))
    after = step(Covisibility(), world, map, index, at=20, frame=frame, inliers=(60, 10, 3))
    assert (after is not None) is made


def test_a_wall_that_is_new_makes_a_keyframe():
    world = World()
    keypoints, segments, planes = world.features(np.eye(4), 0)
    columns = {name: getattr(planes, name)[1:] for name in ("coefficients", "covariance", "moments", "pixels", "samples_m")}
    map = step(Covisibility(), world, None, 0, features=(keypoints, segments, dataclasses.replace(planes, **columns)))
    after = step(Covisibility(), world, map, 9, at=0.2, inliers=(60, 10, 2))
    assert len(after.planes) == 3 and len(after.keyframes) == 2


def test_an_id_is_the_same_landmark_for_good():
    world, maps = World(), []
    for index in range(12):
        maps.append(step(EVERY, world, maps[-1] if maps else None, index, at=3 * index))
    rows = rows_of_world(world, maps[-1])
    for earlier in maps:
        assert np.array_equal(rows_of_world(world, earlier), rows[: len(earlier.points)])
    observations = maps[-1].point_observations
    seen_pixels = []
    for keyframe, (a, b) in enumerate(maps[-1].keyframes.column("points")):
        keypoints, born = world.keypoints(camera_at(3 * keyframe), keyframe)
        of_row = dict(zip(born, keypoints.pixels))
        ids = observations.column("point")[a:b]
        assert (observations.column("keyframe")[a:b] == keyframe).all()
        seen_pixels += [np.allclose(of_row[rows[i]], pixel) for i, pixel in zip(ids, observations.column("pixel")[a:b])]
    assert np.mean(seen_pixels) == 1.0 and len(seen_pixels) > 500


def test_points_converge_and_their_information_is_honest():
    """After 20 looks the mean error is far below that of the first, and normalised by the covariance it is 3 for 3 coordinates."""
    world = World(2000)
    first, last = walk(world, 1), walk(world, 20)
    errors = [map.points.column("position_m") - world.position[rows_of_world(world, map)] for map in (first, last)]
    often = last.points.column("alive") & (last.points.column("found") >= 15)
    assert often.sum() > 50
    before = np.sqrt((errors[0] ** 2).sum(1).mean())
    after = np.sqrt((errors[1][often] ** 2).sum(1).mean())
    assert after < 0.35 * before
    chi2 = np.einsum("ni,nij,nj->n", errors[1], last.points.column("information"), errors[1])[often]
    assert 2.0 < np.median(chi2) * 3.0 / 2.366 < 4.5  # 2.366 is the median of χ² with 3 degrees of freedom


def test_the_information_is_bounded_so_that_a_point_can_still_move():
    world = World()
    short, long = (walk(world, count, dataclasses.replace(EVERY, memory=5.0), stride=0.2) for count in (12, 30))
    everywhere = np.flatnonzero(long.points.column("found")[: len(short.points)] >= 28)
    ratio = np.trace(long.points.rows("information", everywhere), axis1=1, axis2=2) / np.trace(
        short.points.rows("information", everywhere), axis1=1, axis2=2
    )
    assert len(everywhere) > 20 and np.median(ratio) < 1.2  # 2.5 without a bound


def test_lines_converge_and_grow_to_what_was_seen():
    world = World()
    errors, lengths = [], []
    for map in (walk(world, 1), walk(world, 20)):
        same = (map.lines.column("descriptor")[:, None] == world.line_descriptor[None]).all(axis=2).argmax(axis=1)
        true = world.lines[same]
        direction = (true[:, 1] - true[:, 0]) / np.linalg.norm(true[:, 1] - true[:, 0], axis=1, keepdims=True)
        off = map.lines.column("endpoints_m") - true[:, :1]
        off -= (off * direction[:, None]).sum(-1, keepdims=True) * direction[:, None]
        often = map.lines.column("found") >= (1 if len(map.keyframes) == 1 else 12)
        errors.append(np.sqrt((off[often] ** 2).sum(-1).mean()))
        ends = map.lines.column("endpoints_m")[often]
        lengths.append(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean())
    assert errors[1] < 0.5 * errors[0] and errors[1] < 0.02
    assert lengths[1] >= lengths[0]


def test_what_is_known_along_a_line_is_not_forgotten():
    """No segment says anything of it. After some hundred frames it was less than what rounding leaves of the rest, and the matrix no information."""
    ends = np.array([[[-0.7, 0.3, 2.0], [0.6, -0.4, 3.1]]])
    direction = (ends[0, 1] - ends[0, 0]) / np.linalg.norm(ends[0, 1] - ends[0, 0])
    pixels = ends[..., :2] / ends[..., 2:] * 500.0 + 320.0
    information = np.tile(1e4 * np.eye(3), (1, 2, 1, 1))
    for _ in range(1000):
        information = information.astype(np.float32).astype(np.float64)  # as the map keeps it
        noise = np.tile(1e-5 * np.eye(3), (1, 2, 1, 1))
        fuse_lines(np.eye(4), 1e-8 * np.eye(6), np.array([500.0, 500.0, 320.0, 320.0]), ends, information, pixels, ends.copy(), noise, 1.0, 30.0)
    assert np.allclose(direction @ information @ direction, 1e4, rtol=0.05)
    assert (np.linalg.eigvalsh(information) > 9e3).all() and (np.linalg.eigvalsh(information)[..., 1:] > 1e5).all()


def test_planes_converge_to_the_truth_and_keep_their_side():
    """Re-estimated from the summed moments; the normalised error of (a, b, d) is 3 in the mean."""
    chi2, first_error, last_error = [], [], []
    for seed in range(8):
        world = World(seed=seed)
        map, start = walk(world, 15, stride=2), walk(world, 1)
        found, true = map.planes.column("coefficients"), world.planes
        same = (found[:, :3] @ true[:, :3].T).argmax(axis=1)
        assert len(found) == len(set(same))
        for i, k in enumerate(same):
            error = np.array([*(tangent_basis(found[i, :3]).T @ true[k, :3]), true[k, 3] - found[i, 3]])
            chi2.append(error @ np.linalg.solve(map.planes.column("covariance")[i], error))
            if map.planes.column("found")[i] == 15:
                last_error.append(np.linalg.norm(error))
                first_error.append(np.linalg.norm(start.planes.column("coefficients")[i] - true[k]))
    assert np.mean(last_error) < 0.5 * np.mean(first_error)
    assert 1.5 < np.mean(chi2) < 5.0


def test_a_point_that_is_not_found_again_dies_and_the_others_live():
    world = World()
    keypoints, segments, planes = world.features(np.eye(4), 0)
    false = np.flatnonzero(np.isfinite(keypoints.points_m).all(axis=1))[::4]
    spoilt = keypoints.descriptors.copy()
    spoilt[false] = np.random.default_rng(9).integers(0, 256, spoilt[false].shape, dtype=np.uint8)
    map = step(EVERY, world, None, 0, features=(dataclasses.replace(keypoints, descriptors=spoilt), segments, planes))
    ids = np.searchsorted(np.flatnonzero(np.isfinite(keypoints.points_m).all(axis=1)), false)
    for index in range(1, 8):
        map = step(EVERY, world, map, index)
    alive = map.points.column("alive")
    assert alive[ids].mean() < 0.1
    first = np.setdiff1d(np.flatnonzero(map.points.column("first") == 0), ids)
    assert alive[first].mean() > 0.9
    after = step(EVERY, world, map, 8)
    assert after.points.rows("alive", after.point_observations.column("point")[-40:]).all()


@pytest.mark.parametrize("hidden", [False, True])
def test_a_plane_that_is_not_found_again_dies_unless_something_hides_it(hidden):
    """A wall that is entered once more, at half its distance: the camera sees through it, or, in the second case, no farther than 0.3 m."""
    world, map = World(), None
    for index in range(8):
        T = camera_at(index)
        keypoints, segments, planes = world.features(T, index)
        if index == 0:
            scale = {"coefficients": np.array([1.0, 1.0, 1.0, 0.5]), "samples_m": np.float32(0.5)}
            columns = {name: getattr(planes, name) for name in ("coefficients", "covariance", "moments", "pixels", "samples_m")}
            columns = {name: np.concatenate([column, column[:1] * scale.get(name, 1)]) for name, column in columns.items()}
            planes = dataclasses.replace(planes, **columns)
        frame = world.seen(T, index)
        frame = dataclasses.replace(frame, depth_m=np.full_like(frame.depth_m, 0.3)) if hidden else frame
        map = step(EVERY, world, map, index, features=(keypoints, segments, planes), frame=frame)
    count = len(world.features(camera_at(0), 0)[2].coefficients)
    assert list(map.planes.column("alive")[: count + 1]) == [True] * count + [hidden]
    assert (map.planes.column("found")[:count] >= 7).all() and (map.planes.column("visible")[count] == 1) == hidden


def test_twins_are_joined_and_their_observations_go_to_the_older():
    """Every point of the first keyframe is entered twice, the copy under an id of its own; so is every line."""
    world = World(noise=0.3)
    map = step(EVERY, world, None, 0)
    n, m = len(map.points), len(map.lines)
    points, copies = map.points.appended(**{name: map.points.column(name) for name in map.points.schema})
    lines, line_copies = map.lines.appended(**{name: map.lines.column(name) for name in map.lines.schema})
    observations = {name: map.point_observations.column(name) for name in map.point_observations.schema}
    seen, _ = map.point_observations.appended(**{**observations, "point": copies})
    observations = {name: map.line_observations.column(name) for name in map.line_observations.schema}
    seen_lines, _ = map.line_observations.appended(**{**observations, "line": line_copies})
    spans = {"points": np.array([[0, 2 * n]], np.int32), "lines": np.array([[0, 2 * m]], np.int32)}
    keyframes = map.keyframes.updated(np.array([0]), **spans)
    map = dataclasses.replace(map, points=points, lines=lines, point_observations=seen, line_observations=seen_lines, keyframes=keyframes)
    map = step(EVERY, world, map, 1)
    again = np.isin(np.arange(n), map.point_observations.column("point")[2 * n :])
    assert again.sum() > 20
    alive = map.points.column("alive")
    assert alive[:n][again].all() and not alive[n : 2 * n][again].any()
    assert not np.isin(n + np.flatnonzero(again), map.point_observations.column("point")).any()
    alive = map.lines.column("alive")
    assert not (alive[:m] & alive[m : 2 * m])[np.isin(np.arange(m), map.line_observations.column("line")[2 * m :])].any()


def split(planes, gap_m):
    """The largest plane as two, the second turned to the other side and moved back by `gap_m`."""
    names = ("covariance", "moments", "pixels", "samples_m", "coefficients")
    columns = {name: getattr(planes, name)[[0, 0, *range(1, len(planes.pixels))]] for name in names}
    back = np.eye(4)
    back[:3, 3] = -gap_m * planes.coefficients[0, :3]
    columns["moments"][1] = plane_fusion.move_moments(back, columns["moments"][1])
    columns["samples_m"][1] = transform(back, columns["samples_m"][1].astype(float)).astype(np.float32)
    columns["coefficients"][1] = -transform_planes(back, planes.coefficients[:1])[0]
    return dataclasses.replace(planes, **columns)


def test_the_two_faces_of_a_thin_wall_stay_two():
    world = World()
    map = None
    for index in range(5):
        keypoints, segments, planes = world.features(camera_at(index), index)
        map = step(EVERY, world, map, index, features=(keypoints, segments, split(planes, 0.02)))
    assert map.planes.column("alive").sum() == len(map.planes) == 4
    a, b = map.planes.column("coefficients")[:2]
    assert a[:3] @ b[:3] < -0.999 and abs(abs(a[3] + b[3]) - 0.02) < 0.005


def test_a_wall_entered_twice_becomes_one():
    world = World()
    map = step(EVERY, world, None, 0)
    columns = {name: map.planes.column(name)[[0]] for name in map.planes.schema}
    columns["observers"][0, 0] = 1
    planes, copy = map.planes.appended(**columns)
    map = step(EVERY, world, dataclasses.replace(map, planes=planes), 1)
    said = {name: columns[name] for name in ("coefficients", "covariance", "moments")}
    seen, _ = map.plane_observations.appended(keyframe=[1], plane=copy, **said)
    span = map.keyframes.column("planes")[1] + [0, 1]
    map = dataclasses.replace(map, plane_observations=seen, keyframes=map.keyframes.updated(np.array([1]), planes=span[None]))
    map = step(EVERY, world, map, 2)
    assert list(map.planes.column("alive")) == [True, True, True, False]
    assert not (map.plane_observations.column("plane") == copy).any()


def test_a_keyframe_without_features_is_no_error():
    bare = World(points=0)
    bare.lines = bare.lines[:0]
    keypoints, segments, planes = bare.features(camera_at(0), 0)
    columns = {name: getattr(planes, name)[:0] for name in ("coefficients", "covariance", "moments", "pixels", "samples_m")}
    nothing = (keypoints, segments, dataclasses.replace(planes, **columns))
    map = step(EVERY, bare, None, 0, features=nothing)
    assert len(map.keyframes) == 1 and len(map.points) == len(map.lines) == len(map.planes) == 0
    world = World()
    map = step(EVERY, world, map, 1)
    map = step(EVERY, world, map, 2, features=nothing)
    assert len(step(EVERY, world, map, 3).keyframes) == 4


def test_the_same_input_gives_the_same_bytes():
    maps = [walk(World(), 6, stride=3) for _ in range(2)]
    for table in TABLES:
        a, b = (getattr(map, table) for map in maps)
        assert all(a.column(name).tobytes() == b.column(name).tobytes() for name in a.schema)


def test_the_motion_between_two_planes_is_the_smallest():
    rng = np.random.default_rng(0)
    old = np.array([*rng.normal(size=3), 0.7])
    old[:3] /= np.linalg.norm(old[:3])
    new = transform_planes(exp_se3(rng.normal(size=6) * 0.1), old[None])[0]
    centre = -old[3] * old[:3] + tangent_basis(old[:3]) @ [0.4, -0.3]
    T = plane_fusion.motions_between(old[None], new[None], centre[None])[0]
    assert np.allclose(transform_planes(T, old[None])[0], new)
    across = transform(T, centre) - centre
    assert np.allclose(across - new[:3] * (new[:3] @ across), 0.0, atol=1e-12)
    assert np.allclose(invert(T) @ T, np.eye(4))


@pytest.mark.parametrize(
    "options, field",
    [({"min_frames": 0}, "min_frames"), ({"memory": 1.0}, "memory"), ({"min_shift": 0.0}, "min_shift"), ({"min_found": 1.1}, "min_found")],
)
def test_ranges_are_checked(options, field):
    with pytest.raises(ValueError, match=field):
        Covisibility(**options)
