"""Three keyframes of a sub-map that agree on the motion between two worlds merge it; fewer, or any that disagree, do not."""

from dataclasses import replace

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import exp_se3, log_se3
from trihedron.pipeline.core.types import CALIBRATION, Pose
from trihedron.pipeline.record.codec import Decoder, Encoder
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.mapping.landmarks import empty_map
from trihedron.plugins.mapping.merge_verification import MAX_AGE, propose_merge, proposed_submaps

AWAY = exp_se3(np.array([3.0, -1.0, 0.5, 0.1, 1.2, -0.3]))  # from the world to that of the sub-map
COVARIANCE = np.diag(np.repeat(np.square([1e-3, 1e-3]), 3))
OLDER, NEWER = range(4), range(4, 10)  # keyframes of both


def camera_at(step):
    return exp_se3(np.array([0.02, 0.004, 0.012, 0.004, 0.01, 0.002]) * step)


@pytest.fixture
def map():
    """Keyframes 0 to 3 of sub-map 0 and 4 to 9 of sub-map 1, one every five steps; the camera turns about the same room."""
    poses = np.stack([camera_at(5.0 * k) for k in OLDER] + [AWAY @ camera_at(5.0 * k) for k in NEWER])
    n, made = len(poses), empty_map(0, 0, 32, 32, 8)
    keyframes, _ = made.keyframes.appended(
        index=np.arange(n) * 5, stamp_ns=np.arange(n), T_world_camera=poses, covariance=np.tile(COVARIANCE, (n, 1, 1)),
        world_covariance=np.tile(COVARIANCE, (n, 1, 1)), sensitivity=np.zeros((n, 6, CALIBRATION)), twist=np.zeros((n, 6)),
        aligned=np.zeros((n, 6)), undone=np.zeros((n, 6)), undone_sensitivity=np.zeros((n, 6, CALIBRATION)),
        intrinsics=np.ones((n, 4)), points=np.zeros((n, 2)), lines=np.zeros((n, 2)), planes=np.zeros((n, 2)),
        submap=np.array([0] * len(OLDER) + [1] * len(NEWER)), alive=np.ones(n, np.bool_),
    )  # fmt: skip
    return replace(made, keyframes=keyframes)


def pose_of(map, T, index, reference, status, submap):
    relative = invert(map.keyframes.row("T_world_camera", reference)) @ T
    return Pose(index, index, T, COVARIANCE, relative, reference, np.zeros(3, np.int32), 0, status, "", submap)


def recognise(map, index, keyframe, error=(0.0,) * 6, older=3, by=3):
    """The map and the verified pose after the frame of this index, near a keyframe of the sub-map, was recognised with an error (m, rad)."""
    T = camera_at(index)
    here = map.keyframes.row("T_world_camera", keyframe) @ invert(camera_at(5.0 * keyframe)) @ T
    pose = pose_of(map, here, index, keyframe, "degraded", 1)
    return propose_merge(map, pose, pose_of(map, T @ exp_se3(np.asarray(error)), index, older, "degraded", 0), by)


def outcomes(map, *recognitions, by=3):
    """Whether each recognition, (frame, keyframe, error in x), merges."""
    merged = []
    for index, keyframe, x in recognitions:
        map, pose = recognise(map, index, keyframe, (x, 0, 0, 0, 0, 0), by=by)
        merged.append(pose is not None)
    return merged


def test_three_that_agree_merge_at_their_mean(map):
    for index, keyframe, x in ((20, 4, 0.0), (25, 5, 0.03)):
        map, pose = recognise(map, index, keyframe, (x, 0, 0, 0, 0, 0))
        assert pose is None
    map, pose = recognise(map, 30, 6, (-0.015, 0, 0, 0, 0, 0))
    assert len(map.proposals) == 3 and np.abs(log_se3(invert(camera_at(30)) @ pose.T_world_camera)).max() < 6e-3
    assert np.allclose(map.keyframes.row("T_world_camera", 3) @ pose.T_reference_camera, pose.T_world_camera)
    limit = 2.0 * COVARIANCE[0, 0]  # of one recognition, both poses; the mean is not stated to be more certain, but for the lever arm
    assert 0.9 * limit < pose.covariance[0, 0] < 1.2 * limit


def test_two_do_not(map):
    assert outcomes(map, (20, 4, 0.0), (25, 5, 0.0)) == [False, False]
    assert outcomes(map, (20, 4, 0.0), (25, 5, 0.0), by=2) == [False, True]


@pytest.mark.parametrize("wrong", range(3))
def test_three_of_which_one_disagrees_do_not_until_three_others_follow(map, wrong):
    errors = [0.15 * (k == wrong) for k in range(3)] + [0.0] * 3
    merged = outcomes(map, *((20 + 5 * k, 4 + k, x) for k, x in enumerate(errors)))
    assert merged.index(True) == 3 + wrong


def test_a_rotation_that_disagrees_does_not(map):
    map = recognise(recognise(map, 20, 4)[0], 25, 5)[0]
    assert recognise(map, 30, 6, (0, 0, 0, 0, np.radians(2.0), 0))[1] is not None
    assert recognise(map, 30, 6, (0, 0, 0, 0, np.radians(6.0), 0))[1] is None


def test_views_count_where_the_camera_moved_between_them(map):
    """A step is 2.4 cm and 0.6°: the third counts, and the third after that, relative to the same keyframe or not."""
    assert outcomes(map, (20, 4, 0.0), (22, 5, 0.0), (23, 4, 0.0), (25, 4, 0.0), (26, 4, 0.0)) == [False] * 4 + [True]


def test_each_frame_looks_for_more_after_a_proposal(map):
    """For 15 frames, in the older sub-map that was proposed; not from the sub-map that is proposed, nor once both are merged."""
    map, _ = recognise(map, 20, 4)
    assert proposed_submaps(map, 1, 35).tolist() == [0] and not len(proposed_submaps(map, 1, 36)) and not len(proposed_submaps(map, 0, 21))
    merged = replace(map, keyframes=map.keyframes.updated(np.array(NEWER), submap=np.zeros(len(NEWER), np.int32)))
    assert not len(proposed_submaps(merged, 0, 21))


def test_what_is_too_old_does_not_count(map):
    assert outcomes(map, (20, 4, 0.0), (25, 5, 0.0), (20 + MAX_AGE, 6, 0.0)) == [False, False, True]
    assert outcomes(map, (20, 4, 0.0), (25, 5, 0.0), (21 + MAX_AGE, 6, 0.0)) == [False, False, False]


def test_proposals_follow_corrections_of_both_sub_maps(map):
    """Bundle adjustment moves the sub-map, and a loop the older one, between two recognitions."""
    for index, keyframe in ((20, 4), (25, 5)):
        map, _ = recognise(map, index, keyframe)
    moved, rows = exp_se3(np.array([0.5, 0.2, -0.1, 0.05, 0.1, 0.0])), np.array(NEWER)
    map = replace(map, keyframes=map.keyframes.updated(rows, T_world_camera=moved @ map.keyframes.rows("T_world_camera", rows)))
    map, pose = recognise(map, 30, 6)
    assert np.allclose(pose.T_world_camera, camera_at(30), atol=1e-9)


def test_proposals_of_other_sub_maps_do_not_count(map):
    """Recognised twice in one older sub-map and once in another."""
    map = replace(map, keyframes=map.keyframes.updated(np.array([0]), submap=np.array([2])))
    for index, keyframe in ((20, 4), (25, 5)):
        map, _ = recognise(map, index, keyframe)
    T = camera_at(30)
    pose = pose_of(map, AWAY @ T, 30, 6, "degraded", 1)
    assert propose_merge(map, pose, pose_of(map, T, 30, 0, "degraded", 2), 3)[1] is None
    assert propose_merge(map, pose, pose_of(map, T, 30, 3, "degraded", 0), 3)[1] is not None


def test_a_pose_without_a_keyframe_proposes_nothing(map):
    T = camera_at(20)
    recognised, pose = pose_of(map, T, 20, 3, "degraded", 0), pose_of(map, AWAY @ T, 20, 4, "degraded", 1)
    for here, there in ((replace(pose, reference=-1), recognised), (pose, replace(recognised, reference=-1)), (recognised, recognised)):
        assert propose_merge(map, here, there, 3) == (map, None)


def test_memory_of_old_proposals_is_freed(map):
    for index in range(20, 20 + 5 * 700, 5):
        map, _ = recognise(map, index, 4 + index // 5 % 6, (0.5 * (index % 2), 0, 0, 0, 0, 0))
    assert len(map.proposals) == 700 and map.proposals.freed == {0, 1}


def test_proposals_are_recorded_as_they_are(map):
    encoder, decoder = Encoder(), Decoder("a")
    for index, keyframe in ((20, 4), (25, 5), (30, 6)):
        map, _ = recognise(map, index, keyframe)
        read = decoder.decode(encoder.encode(map))
        assert all(np.array_equal(read.proposals.column(name), map.proposals.column(name)) for name in map.proposals.schema)


def test_verified_by_counts_from_one():
    with pytest.raises(ValueError, match="verified_by"):
        Covisibility(verified_by=0)
