"""The distances between points are those of the map, whatever the pose and whatever moves; where most are larger or smaller, depth contradicts it."""

import dataclasses

import numpy as np
import pytest

from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import Pose
from trihedron.plugins.pose.judgement import judge_by_run
from trihedron.plugins.shared.distance_scale import contradicting_scale, scale_difference

POSE = Pose(1, 0, np.eye(4), 1e-6 * np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", "")


def points_and_noise(count=200, noise=0.01, seed=0):
    """Points in a room, up to 4 m away, and the same with a noise of this share of their depth."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1.5, -1.0, 1.0], [1.5, 1.0, 4.0], (count, 3))
    return points, (points * (1.0 + noise * rng.normal(size=(count, 1)))).astype(np.float32)


@pytest.mark.parametrize("seed", range(20))
def test_noise_and_a_motion_leave_distances_as_they_are(seed):
    """Points seen with an error of 1 % of their depth from elsewhere, half a metre and 60° on."""
    known, found = points_and_noise(seed=seed)
    T = exp_se3(np.array([0.5, 0.0, 0.1, 0.2, 1.0, 0.0]))
    assert scale_difference(known, (found @ T[:3, :3].T + T[:3, 3]).astype(np.float32)) == 0.0


@pytest.mark.parametrize("times, least", [(1.07, 0.04), (0.93, -0.045), (1.03, 0.005), (0.5, -0.65), (2.0, 0.65)])
def test_a_scale_of_depth_that_changed_is_seen(times, least):
    """Nine of ten distances differ by a little less than the scale, as noise makes single ones differ less."""
    known, found = points_and_noise()
    difference = scale_difference(known, times * found)
    assert difference is not None and abs(least) < abs(difference) < abs(np.log(times)) and (difference > 0.0) == (times > 1.0)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_an_object_that_moved_does_not_change_the_scale(share):
    """A part of the points, on its left, is 20 cm further off."""
    known, found = points_and_noise()
    moved = known[:, 0] < np.quantile(known[:, 0], share)
    found[moved, 2] += 0.2
    assert scale_difference(known, found) == 0.0


def test_few_points_show_nothing():
    """19 of 200 have depth."""
    known, found = points_and_noise()
    found[19:] = np.nan
    assert scale_difference(known, 1.2 * found) is None
    assert scale_difference(known[:0], found[:0]) is None
    assert scale_difference(np.zeros((50, 3)), np.zeros((50, 3), np.float32)) is None  # all the same point


def test_a_contradicting_scale_degrades_a_pose():
    larger, smaller = (dataclasses.replace(POSE, scale_difference=difference) for difference in (np.log(1.05), np.log(0.95)))
    reason = "depth and map contradict each other: of late most distances between points are 5.0 % {} than in the map, or more"
    assert [contradicting_scale(pose) for pose in (POSE, larger, smaller)] == ["", reason.format("larger"), reason.format("smaller")]
    judged = judge_by_run(larger, planes_agree=True)
    assert (judged.status, judged.reason) == ("degraded", reason.format("larger"))
