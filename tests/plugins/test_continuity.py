"""A motion that no camera which is carried makes is a jump, and what is usual a run shows by itself."""

import dataclasses

import numpy as np
import pytest

from trihedron.pipeline.core.types import Pose
from trihedron.plugins.pose.continuity import with_motion
from trihedron.plugins.pose.judgement import judge_by_run, since_loss
from trihedron.plugins.shared.contradiction import with_averages_of

PERIOD_NS = 33_333_333
FIRST = Pose(1, 0, np.eye(4), 1e-6 * np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", "")


def follow(pose, position, turn_deg=0.0, **more):
    """The pose of the next frame, judged, at so many metres along x and turned so far about z."""
    T, angle = np.eye(4), np.radians(turn_deg)
    T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    T[0, 3] = position
    found = dataclasses.replace(FIRST, index=pose.index + 1, stamp_ns=pose.stamp_ns + PERIOD_NS, T_world_camera=T, **more)
    return judge_by_run(since_loss(with_motion(found, pose), pose), planes_agree=True)


def walk(positions, **more):
    """The poses of frames at these positions."""
    poses = [FIRST]
    for position in positions:
        poses.append(follow(poses[-1], position, **more))
    return poses[1:]


STEADY = np.arange(1, 61) * 0.03 + 0.004 * np.random.default_rng(0).normal(size=60)  # 0.9 m/s, 4 mm of noise


def test_a_camera_that_is_carried_does_not_jump():
    """Walked for two seconds, with poses that are less exact than they state, and stopped at once."""
    poses = walk([*STEADY, *[STEADY[-1]] * 10])
    assert {pose.status for pose in poses} == {"ok"} and poses[-1].usual_accelerations[1] > 1.0


def test_an_image_from_another_place_is_a_jump():
    """One image of half a metre back among those of a walk: it, the jump forward again, and two frames that confirm the place."""
    positions = STEADY.copy()
    positions[40] -= 0.5
    poses = walk(positions)
    assert [pose.index for pose in poses if pose.status != "ok"] == [42, 43, 44, 45]
    assert poses[40].reason == "a jump: the motion since the previous frame takes 454 m/s², usually at most 6"
    assert poses[42].reason == "found again, which 1 of 3 frames in a row confirm: "
    assert poses[40].lost_from == 42 and poses[41].lost_from == 43
    assert np.array_equal(poses[41].twist, poses[39].twist) and [pose.jumps for pose in poses[39:43]] == [0, 1, 2, 0]


def test_a_camera_that_moves_otherwise_than_before_is_ok_again():
    """At rest for a second, and from one frame to the next at 3 m/s."""
    poses = walk([*0.001 * np.random.default_rng(0).normal(size=30), *0.1 * np.arange(1, 21)])
    assert [pose.index for pose in poses if pose.status != "ok"] == [32, 33, 34, 35, 36] and poses[-1].twist[0] == pytest.approx(3.0, rel=1e-3)


def test_a_camera_that_turns_at_once_has_jumped():
    """By 90° from one frame to the next."""
    poses = walk(STEADY[:30])
    turned = follow(poses[-1], STEADY[30], turn_deg=90.0)
    assert turned.reason == "a jump: the motion since the previous frame takes 1405 rad/s², usually at most 0"


def test_what_is_usual_is_still_known_after_a_loss():
    """A lost frame in a walk, found again in the next, and an image of half a metre back four frames later."""
    walked = walk(STEADY[:30])[-1]
    lost = dataclasses.replace(FIRST, index=walked.index + 1, stamp_ns=walked.stamp_ns + PERIOD_NS, status="lost")
    poses = [since_loss(with_averages_of(walked, lost), walked)]
    for position in [*STEADY[31:35], STEADY[35] - 0.5]:
        poses.append(follow(poses[-1], position))
    assert [pose.jumps for pose in poses] == [0, 0, 0, 0, 0, 1]


@pytest.mark.parametrize("steps", [np.random.default_rng(1).uniform(-0.4, 0.4, 60), np.tile([0.3, -0.2, 0.1], 20)])
def test_images_that_are_far_apart_from_the_start_are_usual(steps):
    """Of a sequence of single images, whose time stamps are those of a video."""
    assert {pose.status for pose in walk(np.cumsum(steps))} == {"ok"}


def test_poses_that_are_uncertain_do_not_jump():
    """By less than four of their standard deviations, of 10 cm along each axis."""
    positions = STEADY.copy()
    positions[40] -= 0.5
    assert {pose.status for pose in walk(positions, covariance=1e-2 * np.eye(6))} == {"ok"}


def test_a_pose_that_is_exact_but_for_rounding_does_not_jump():
    """As the first one of a sub-map, whose covariance less that of the map is not exactly zero."""
    more = dict(covariance=np.eye(6), map_covariance=(1.0 + 1e-12) * np.eye(6))
    poses = walk(STEADY[:20], **more)
    assert {pose.status for pose in poses} == {"ok"} and np.isfinite(poses[-1].usual_accelerations).all()


def test_the_velocity_after_repeated_images_is_that_since_they_were_taken():
    """Three images that repeat an earlier one while the camera goes on at 0.9 m/s."""
    before = walk(0.03 * np.arange(1, 31))[-1]
    poses = [before]
    for repeats in (1, 2, 3):
        poses.append(follow(poses[-1], before.T_world_camera[0, 3], repeats=repeats))
    after = follow(poses[-1], before.T_world_camera[0, 3] + 4 * 0.03)
    assert after.twist[0] == pytest.approx(0.9, rel=1e-6) and np.array_equal(poses[-1].twist, before.twist)
    assert not follow(after, after.T_world_camera[0, 3] + 0.03).lost_from
