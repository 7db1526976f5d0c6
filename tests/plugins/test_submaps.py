"""Sub-maps: begun when nothing is recognised for long, said in a world of their own, tied to the rest without a second copy of a wall."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert, transform
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import Pose
from trihedron.pipeline.run.accounting import Result
from trihedron.pipeline.run.poses import Poses
from trihedron.pipeline.run.results import final_trajectory, is_merged
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.mapping.covisibility_graph import current_submap, local_window, newest_keyframes
from trihedron.plugins.mapping.submaps import split_submap
from trihedron.plugins.matches.local_map import LocalMap
from trihedron.plugins.pose.refine import Refine

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import World, camera_at, rotation_of, translation_of
from map_steps import correction, walk

EVERY = Covisibility(min_frames=1, max_frames=1, min_shift=1e-6, min_turn_deg=1e-6, verified_by=1)
AWAY = exp_se3(np.array([3.0, -1.0, 0.5, 0.1, 1.2, -0.3]))  # from the world to that of the sub-map


def pose_of(T, index, status="ok", **more):
    return replace(Pose(index, index * 33_000_000, T, np.eye(6) * 1e-8, T, -1, np.zeros(3, np.int32), 0, status, ""), **more)


def seen(world, map, index, step, T, **more):
    """The map after the frame seen at `step`, whose pose is said as T."""
    features = world.features(camera_at(step), index)
    matches = LocalMap()(world.frame(index).camera, rotation_of(T, index), translation_of(T, index), *features, map, None) if map else None
    relocalise, bundle, stage, reference = more.pop("recognised", None), more.pop("bundle", None), more.pop("stage", EVERY), more.get("reference", -1)
    if reference >= 0:
        more["T_reference_camera"] = invert(map.keyframes.column("T_world_camera")[reference]) @ T
    return stage(world.frame(index), pose_of(T, index, **more), *features, matches, map, bundle, None, relocalise)


@pytest.fixture
def both():
    """A world, and its map in two parts that do not know of each other: steps 0 to 20, and 12 to 32 in a world that is AWAY."""
    world, map = World(1500), None
    for index, step in enumerate(range(0, 24, 4)):
        map = seen(world, map, index, step, camera_at(step))
    for index, step in enumerate(range(12, 36, 4), 6):
        map = seen(world, map, index, step, AWAY @ camera_at(step), submap=1, reference=index - 1 if index > 6 else -1)
    return world, map


def test_a_sub_map_shares_nothing_with_the_rest(both):
    _, map = both
    assert list(map.keyframes.column("submap")) == [0] * 6 + [1] * 6 and current_submap(map) == 1
    assert map.points.column("first")[np.unique(map.point_observations.column("point")[map.point_observations.column("keyframe") >= 6])].min() >= 6
    assert list(newest_keyframes(map, 9)) == list(range(6, 12))
    assert set(local_window(map, camera_at(20), 2, 10, 3).keyframes) <= set(range(6, 12))
    assert set(local_window(map, camera_at(20), 2, 10, 3, submap=0).keyframes) == {3, 4, 5}
    assert map.planes.column("alive").sum() == 6  # three walls, each twice


def test_a_sub_map_is_merged_where_the_camera_is_recognised(both):
    """Everything moves by AWAY's inverse, walls are one again, and the next frame finds landmarks of both."""
    world, map = both
    step = 33
    recognised = pose_of(camera_at(step), 12, "degraded", submap=0)
    after = seen(world, map, 12, step, AWAY @ camera_at(step), status="degraded", submap=1, reference=11, recognised=recognised)
    assert not after.keyframes.column("submap").any()
    poses = after.keyframes.column("T_world_camera")
    assert np.allclose(poses[6:12], invert(AWAY) @ map.keyframes.column("T_world_camera")[6:12])
    assert np.allclose(poses[12], camera_at(step))
    assert after.planes.column("alive").sum() == 3
    ids = np.flatnonzero(after.planes.column("alive"))
    for wall in after.planes.rows("coefficients", ids):
        assert np.abs(world.planes @ np.append(wall[:3], 0.0) - 1.0).min() < 1e-3 and np.abs(world.planes - wall).max(axis=1).min() < 0.02
    moved = np.flatnonzero(map.points.column("alive") & (map.points.column("first") >= 6))[:50]
    untouched = np.isclose(after.points.rows("found", moved), map.points.rows("found", moved))  # not measured again by the frame itself
    expected = transform(invert(AWAY), map.points.rows("position_m", moved))
    assert np.allclose(after.points.rows("position_m", moved)[untouched], expected[untouched], atol=2.0**-20)  # the steps of places
    assert len(set(local_window(after, camera_at(20), 2, 10, 5).keyframes) & set(range(6))) >= 3


def test_a_sub_map_is_merged_by_the_third_keyframe_that_is_recognised(both):
    """The first two only propose it."""
    world, map = both
    stage, older = replace(EVERY, verified_by=3), map.keyframes.row("T_world_camera", 5)
    for index, step in ((12, 33), (17, 36), (22, 39)):
        T = camera_at(step)
        recognised = pose_of(T, index, "degraded", reference=5, T_reference_camera=invert(older) @ T)
        reference = len(map.keyframes) - 1
        map = seen(world, map, index, step, AWAY @ T, status="degraded", submap=1, reference=reference, recognised=recognised, stage=stage)
        assert map.keyframes.column("submap")[6:].any() == (index < 22) and (map.loop_closed == map.revision) == (index == 22)
    poses = map.keyframes.column("T_world_camera")
    assert len(map.proposals) == 3 and map.planes.column("alive").sum() == 3
    assert all(np.allclose(poses[row], camera_at(step), atol=1e-6) for row, step in zip(range(6, 15), (*range(12, 36, 4), 33, 36, 39)))


def test_a_merge_is_undone_by_keeping_the_sub_map_apart(both, caplog):
    """The frame that merges it says how; with that the map goes on in the sub-map's own world."""
    world, map = both
    merging = {"status": "degraded", "submap": 1, "reference": 11, "recognised": pose_of(camera_at(33), 12, "degraded", submap=0)}
    merged = seen(world, map, 12, 33, AWAY @ camera_at(33), **merging)
    assert caplog.messages == ["map: sub-map 1 is merged with 0 at frame 12; map.apart=[1] undoes it"]
    apart = seen(world, map, 12, 33, AWAY @ camera_at(33), stage=replace(EVERY, apart=(1,)), **merging)
    assert not merged.keyframes.column("submap").any() and apart.keyframes.column("submap").tolist() == [0] * 6 + [1] * 7
    assert np.allclose(apart.keyframes.column("T_world_camera")[12], AWAY @ camera_at(33)) and apart.loop_closed == map.loop_closed
    assert apart.planes.column("alive").sum() == 6 and len(caplog.messages) == 1
    other = replace(EVERY, apart=(2,))
    assert not seen(world, map, 12, 33, AWAY @ camera_at(33), stage=other, **merging).keyframes.column("submap").any()


def test_an_adjustment_that_began_before_sub_maps_were_merged_does_not_undo_it(both):
    """The bundle adjustment of the version before still has the keyframes in the world of the sub-map."""
    world, map = both
    rows = np.arange(6, 12, dtype=np.int32)
    late = correction(map, keyframe_ids=rows, T_world_keyframe=map.keyframes.rows("T_world_camera", rows))
    recognised, merging = pose_of(camera_at(33), 12, "degraded", submap=0), {"status": "degraded", "submap": 1, "reference": 11}
    merged = seen(world, map, 12, 33, AWAY @ camera_at(33), recognised=recognised, **merging)
    assert merged.loop_closed == merged.revision
    after = seen(world, merged, 13, 33, camera_at(33), bundle=late)
    assert np.array_equal(after.keyframes.rows("T_world_camera", rows), merged.keyframes.rows("T_world_camera", rows))


def test_frames_of_a_sub_map_count_once_it_is_merged(both):
    _, map = both
    poses = [pose_of(camera_at(0), 0, reference=0), pose_of(AWAY, 20, "degraded", submap=1, reference=8), pose_of(AWAY, 21, "lost", reference=8)]
    assert [is_merged(pose, map) for pose in poses] == [True, False, False] and len(final_trajectory(Result(Poses(poses), map))) == 1
    tied = replace(map, keyframes=map.keyframes.updated(np.arange(6, 12), submap=np.zeros(6, np.int32)))
    assert [is_merged(pose, tied) for pose in poses] == [True, True, False] and len(final_trajectory(Result(Poses(poses), tied))) == 2


def test_a_new_sub_map_begins_after_as_many_frames_as_were_sought_in_vain():
    """Fifteen frames whose tracks are good and whose place is not known; one without tracks, without a search, or without depth, does not count."""
    world, other = World(), World(seed=5)
    map = seen(other, None, 0, 0, np.eye(4))
    pose, stage = pose_of(np.eye(4), 0, "lost", reference=0), Refine(submap_after=15)
    statuses = []
    for index in range(1, 20):
        T, features = camera_at(index), world.features(camera_at(index), index)
        features = without_depth(*features) if index == 6 else features
        translation = translation_of(T, index, estimated=index != 4)
        matches = LocalMap()(world.frame(index).camera, rotation_of(T, index), translation, *features, map, None)
        sought = replace(pose, index=index) if index != 5 else None
        pose = stage(world.frame(index).camera, rotation_of(T, index), translation, None, matches, *features, pose, map, sought)
        statuses.append((pose.status, pose.submap))
        if pose.submap:
            break
    assert statuses == [("lost", 0)] * 17 + [("degraded", 1)]
    assert pose.reason == "first frame of sub-map 1: relocalisation failed for 15 frames" and pose.reference == -1
    assert np.linalg.eigvalsh(pose.covariance).max() < 1e-9


def without_depth(keypoints, segments, planes):
    """Features of a frame in whose image nothing has depth."""
    nowhere = np.full_like(keypoints.points_m, np.nan), np.full_like(segments.endpoints_m, np.nan)
    none = {name: getattr(planes, name)[:0] for name in ("coefficients", "covariance", "moments", "pixels", "samples_m")}
    none["labels"] = np.zeros_like(planes.labels)
    return replace(keypoints, points_m=nowhere[0]), replace(segments, endpoints_m=nowhere[1]), replace(planes, **none)


def test_what_was_mapped_since_a_loss_is_split_off_with_landmarks_of_its_own():
    """Six keyframes of one walk, as if the camera had been lost after the first three: what both halves observed are two landmarks from then on."""
    map = walk(World(1500), 6, stride=4)
    middle = int(map.keyframes.row("index", 3))
    pose = pose_of(camera_at(0), 0, lost_from=middle, missing=0.97, reference=len(map.keyframes) - 1)
    split = split_submap(map, pose)
    assert split.keyframes.column("submap").tolist() == [0, 0, 0, 1, 1, 1]
    assert len(split.points) > len(map.points) and len(split.planes) > len(map.planes)
    for table in (split.points, split.lines, split.planes):
        first, observers = (table.column(name)[table.column("alive")] for name in ("first", "observers"))
        late = first[:, None] >= 3
        assert ((observers < 0) | ((observers >= 3) == late)).all() and (late & (observers >= 3)).any()
    for submap in (0, 1):
        seen_by = local_window(split, camera_at(0), 2, 10, 3, submap=submap).points
        assert len(seen_by) and ((split.points.rows("first", seen_by) >= 3) == bool(submap)).all()
    assert split_submap(map, replace(pose, reference=0)) is map  # relative to a keyframe of the rest
