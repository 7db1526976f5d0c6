"""Relocalisation: places seen before are recognised, places never seen and rooms that look the same from two sides are not."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, pose_matrix
from trihedron.pipeline.core.lie import exp_se3, exp_so3, rotation_angle_deg
from trihedron.pipeline.core.types import LOST, Pose
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.mapping.landmark_kinds import observations_of
from trihedron.plugins.matches.local_map import LocalMap
from trihedron.plugins.places.verification import least_share
from trihedron.plugins.relocalise.features import Features

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import INTO_CORNER, World, camera_at, rotation_of, translation_of

EVERY = Covisibility(min_frames=1, max_frames=1, min_shift=1e-6, min_turn_deg=1e-6)
STEPS = range(0, 60, 6)  # where the map was made: 1.3 m of the way, 36° of the turn


def pose_of(T, index, status="ok"):
    return Pose(index, index * 33_000_000, T, np.eye(6) * 1e-8, T, -1, np.zeros(3, np.int32), 0, status, "")


def mapped(world, poses=None):
    """The map that keyframes at the poses (None: at STEPS) make, which are exact."""
    map = None
    for i, T in enumerate(poses or [camera_at(step) for step in STEPS]):
        features = world.features(T, i)
        matches = LocalMap()(world.frame(i).camera, rotation_of(T, i), translation_of(T, i), *features, map, None) if map else None
        map = EVERY(world.frame(i), pose_of(T, i), *features, matches, map, None, None, None) or map
    return map


def manhattan_of(T, index, turn=0):
    """The rotation stage of a lost camera: the room's axes seen, and known in the world; its own rotation is far off."""
    R_world, off = INTO_CORNER[:3, :3], exp_so3(np.array([0.4, 1.9, -0.7]))
    named = R_world @ np.roll(np.eye(3), turn, axis=0)  # any of the names of the axes
    return dataclasses.replace(
        rotation_of(pose_matrix(T[:3, :3] @ off, T[:3, 3]), index),
        R_world_manhattan=R_world[None], R_camera_manhattan=(T[:3, :3].T @ named)[None], ids=np.zeros(1, np.int32), weights=np.full(1, 100.0),
    )  # fmt: skip


def recognise(world, map, T, index, kinds=("points", "lines", "planes"), status=LOST, stage=None, farther=1.0):
    """What the stage says of the view from T, with the features of the given kinds."""
    keypoints, segments, planes = world.features(T, index)
    if "points" not in kinds:
        arrays = {field.name: getattr(keypoints, field.name) for field in dataclasses.fields(keypoints)}
        keypoints = dataclasses.replace(keypoints, **{name: rows[:0] for name, rows in arrays.items() if isinstance(rows, np.ndarray)})
    rng = np.random.default_rng(index)
    previous = pose_of(np.eye(4), index - 1, status)
    frame = world.seen(T, index, farther)
    found = (stage or Features())(frame, manhattan_of(T, index, index % 3), keypoints, segments, planes, map, previous, rng)
    assert found is None or (found.index == index and (found.status != LOST or found.reason == "nothing was recognised"))
    return found if found is not None and found.status != LOST else None


def error(pose, T):
    D = invert(T) @ pose.T_world_camera
    return np.linalg.norm(D[:3, 3]), rotation_angle_deg(D[:3, :3])


def views(count, seed=0):
    """Places near the mapped way, off it by decimetres and by up to 15° or so."""
    rng = np.random.default_rng(seed)
    for step in rng.uniform(0.0, 54.0, count):
        yield camera_at(step) @ exp_se3(np.concatenate([rng.normal(0.0, 0.1, 3), rng.normal(0.0, np.radians(5.0), 3)]))


@pytest.fixture(scope="module")
def world():
    return World(2000, marks=400)


@pytest.fixture(scope="module")
def map(world):
    return mapped(world)


@pytest.mark.parametrize("kinds", [("points", "lines", "planes"), ("lines", "planes")])
def test_a_kidnapped_camera_is_found(world, map, kinds):
    """By the layout alone too: no point is needed."""
    found = [(pose, T) for i, T in enumerate(views(20)) if (pose := recognise(world, map, T, 200 + i, kinds)) is not None]
    errors = np.array([error(pose, T) for pose, T in found])
    print(f"{len(found)} of 20, at most {errors[:, 0].max():.4f} m {errors[:, 1].max():.3f} degrees")
    assert len(found) >= (20 if "points" in kinds else 16)
    assert errors[:, 0].max() < 0.02 and errors[:, 1].max() < 1.0
    assert all(pose.status == "ok" and pose.reference == len(map.keyframes) - 1 for pose, _ in found)


def test_a_place_that_is_not_in_the_map_is_refused(map):
    """Other rooms of the same size, each with walls at the same distances and details of its own."""
    for seed in range(1, 6):
        other = World(2000, seed, marks=400)
        assert all(recognise(other, map, T, 300 + i) is None for i, T in enumerate(views(4, seed)))


def test_a_box_that_looks_the_same_from_two_sides_is_refused():
    """Walls and their 12 edges, all edges alike, seen from the middle all around: however little is asked for, there is always another place.
    Marks on the walls make the difference."""
    around = [INTO_CORNER @ exp_se3(np.array([0, 0, 0, 0, yaw, 0.0])) for yaw in np.linspace(0.0, 2.0 * np.pi, 25)[:-1]]
    asked = Features(min_score=10, min_details=1, near=24)
    bare, furnished = World(1), World(1, marks=200)
    bare.lines, bare.line_descriptor = bare.lines[:12], np.zeros((12, 32), np.uint8)
    answers = {}
    for name, room in (("bare", bare), ("furnished", furnished)):
        map = mapped(room, around)
        places = [T @ exp_se3(np.array([0.2, 0.05, -0.1, 0, 0.1, 0])) for T in around[::4]]
        answers[name] = [(recognise(room, map, T, 400 + i, ("lines", "planes"), stage=asked), T) for i, T in enumerate(places)]
    assert all(pose is None for pose, _ in answers["bare"])
    found = [error(pose, T) for pose, T in answers["furnished"] if pose is not None]
    assert len(found) >= 5 and np.max(found, axis=0)[0] < 0.02


def test_two_places_that_look_alike_are_refused(world):
    """The same points, lines and descriptors twice, 20 m apart: whichever the camera is at, it cannot tell."""
    one, step = mapped(world), np.array([20.0, 0.0, 0.0])
    twin = dataclasses.replace(
        one,
        **{name: getattr(one, name).appended(**columns)[0] for name, columns in shifted(one, step).items()},
    )
    assert recognise(world, one, camera_at(31), 500) is not None
    assert recognise(world, twin, camera_at(31), 500) is None


def shifted(map, step):
    """All rows of the map's tables once more, moved by `step` and numbered on."""
    counts = {"keyframe": len(map.keyframes), "point": len(map.points), "line": len(map.lines), "plane": len(map.planes)}
    tables = {}
    for name in ("keyframes", "points", "lines", "planes", "point_observations", "line_observations", "plane_observations"):
        table = getattr(map, name)
        columns = {column: table.column(column).copy() for column in table.schema}
        for column in columns:
            if column in counts:
                columns[column] += counts[column]
        if "observers" in columns:
            columns["observers"][columns["observers"] >= 0] += counts["keyframe"]
            columns["first"] += counts["keyframe"]
        if name == "keyframes":
            columns["T_world_camera"][:, :3, 3] += step
            for kind, table in observations_of(map).items():
                columns[kind.span_column] += len(table)
        if name == "points":
            columns["position_m"] += step
        if name == "lines":
            columns["endpoints_m"] += step
        if name == "planes":
            columns["coefficients"][:, 3] -= columns["coefficients"][:, :3] @ step
            columns["samples_m"] += step.astype(np.float32)
        tables[name] = columns
    return tables


def test_a_place_that_would_hang_in_free_space_is_refused(world, map):
    """All features fit, but the camera sees twice as far as the walls that they are on."""
    assert recognise(world, map, camera_at(31), 700) is not None
    assert recognise(world, map, camera_at(31), 700, farther=2.0) is None
    assert recognise(world, map, camera_at(31), 700, farther=2.0, stage=Features(max_through=1.0)) is not None


def test_a_place_where_most_of_what_should_be_seen_is_not_is_refused(world, map):
    """One point in twenty, one line in forty and the walls of the mapped one: what agrees is right, but little of what is expected."""
    other = dataclasses.replace(world, seed=7)
    same, marks = np.arange(0, 2000, 20), np.arange(0, len(world.lines), 40)
    other.position[same], other.descriptor[same] = world.position[same], world.descriptor[same]
    other.lines[marks], other.line_descriptor[marks] = world.lines[marks], world.line_descriptor[marks]
    asked = Features(min_score=10, min_details=10)
    assert recognise(other, map, camera_at(31), 800, stage=asked) is None
    found = recognise(other, map, camera_at(31), 800, stage=dataclasses.replace(asked, min_found=0.0))
    assert found is not None and error(found, camera_at(31))[0] < 0.05


@pytest.mark.parametrize("strange", ["keypoints", "segments"])
def test_a_place_where_one_kind_of_detail_is_unknown_is_refused(world, map, strange):
    """Walls and lines as in the map with other points are another room; the same points with other lines are a pattern that repeats."""
    T, other = camera_at(30), World(2000, 1, marks=400)
    keypoints, segments, planes = world.features(T, 40)
    inliers = np.array([300, 60, 5], np.int32)
    inliers[0 if strange == "keypoints" else 1] = 1
    matches = dataclasses.replace(
        LocalMap()(world.frame(40).camera, rotation_of(T, 40), translation_of(T, 40), keypoints, segments, planes, map, None),
        visible_points=np.arange(400, dtype=np.int32), visible_lines=np.arange(80, dtype=np.int32),
    )  # fmt: skip
    assert least_share(inliers, matches, keypoints) < Features().min_each < least_share(np.array([300, 60, 5]), matches, keypoints)
    few = dataclasses.replace(matches, visible_points=np.arange(99, dtype=np.int32), visible_lines=np.arange(29, dtype=np.int32))
    assert least_share(inliers, few, keypoints) == 1.0
    if strange == "keypoints":
        frame, previous = world.seen(T, 40), pose_of(np.eye(4), 39, LOST)
        shown = other.features(T, 40)[0], segments, planes
        assert Features()(frame, manhattan_of(T, 40), *shown, map, previous, np.random.default_rng(0)).status == LOST


def test_it_runs_for_a_lost_camera_only(world, map):
    assert recognise(world, map, camera_at(31), 200, status="ok") is None
    assert recognise(world, None, camera_at(31), 200) is None


def test_a_camera_tracked_in_a_sub_map_is_sought_in_the_older_ones_every_few_frames(world, map):
    """The sub-map holds one keyframe of another place; the pose said of the view is in the world of the first."""
    other = World(2000, 9, marks=400)
    features = other.features(np.eye(4), 100)
    origin = dataclasses.replace(pose_of(np.eye(4), 100, "degraded"), submap=1)
    both = EVERY(other.frame(100), origin, *features, None, map, None, None, None)
    previous = dataclasses.replace(origin, reference=len(map.keyframes))
    assert list(both.keyframes.column("submap")) == [0] * len(map.keyframes) + [1]
    T = camera_at(31)
    for index in (200, 201):
        found = Features(every=5)(
            world.seen(T, index), manhattan_of(T, index), *world.features(T, index), both, dataclasses.replace(previous, index=index - 1),
            np.random.default_rng(0),
        )  # fmt: skip
        assert (found is None) == (index == 201)
        if found is not None:
            assert (found.status, found.submap, found.reference) == ("degraded", 0, len(map.keyframes) - 1) and error(found, T)[0] < 0.01


def test_the_same_input_gives_the_same_bytes(world, map):
    poses = [recognise(world, map, camera_at(31), 200) for _ in range(2)]
    assert poses[0].T_world_camera.tobytes() == poses[1].T_world_camera.tobytes()


def test_a_large_map_is_looked_through_block_by_block(world, map):
    """Ten keyframes in blocks of four: some frame of a full round recognises the place, and each looks at four keyframes only."""
    stage = Features(block=4, candidates=4)
    found = [recognise(world, map, camera_at(49), 600 + i, stage=stage) for i in range(5)]
    assert any(pose is not None for pose in found)
    assert all(error(pose, camera_at(49))[0] < 0.02 for pose in found if pose is not None)


@pytest.mark.parametrize("options", [{"block": 0}, {"ratio": 0.0}, {"rival": 1.5}, {"floor_m": 0.0}, {"min_share": 2.0}, {"min_found": -0.1}])
def test_ranges_are_checked(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        Features(**options)
