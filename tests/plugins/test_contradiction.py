"""Planes that disagree with the pose more than usual are a contradiction, and a contradicted pose is not continued without the map."""

import dataclasses

import numpy as np
import pytest

from trihedron.pipeline.core.types import Pose
from trihedron.plugins.pose.judgement import judge_by_run
from trihedron.plugins.shared.contradiction import contradiction_so_far, plane_counts

FIRST = Pose(0, 0, np.eye(4), np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", "")


def followed(pose, frames, agreed, matched=10):
    """The poses of so many frames, in each of which so many planes are matched, and so many of them agree."""
    poses = [pose]
    for _ in range(frames):
        poses.append(dataclasses.replace(poses[-1], plane_counts=plane_counts(poses[-1], matched, agreed)))
    return poses[1:]


def test_planes_that_disagree_more_than_usual_are_a_contradiction():
    """Nine of ten planes agree for forty frames, and one of ten from then on: seen within nine frames, and over with them."""
    clean = followed(FIRST, 40, 9)
    frozen = followed(clean[-1], 20, 1)
    after = followed(frozen[-1], 20, 9)
    assert not any(map(contradiction_so_far, clean))
    assert not any(map(contradiction_so_far, frozen[:3])) and all(map(contradiction_so_far, frozen[8:]))
    assert not any(map(contradiction_so_far, after[2:]))
    judged = judge_by_run(frozen[8], planes_agree=False)
    assert judged.status == "degraded"
    assert judged.reason == "colour and depth contradict each other: of late 70 % of the planes disagree with the points, usually 30 %"


@pytest.mark.parametrize("matched, agreed", [(10, 1), (3, 0), (12, 12), (0, 0)])
def test_what_is_usual_is_none(matched, agreed):
    """A miscalibrated camera, of whose planes hardly any agree for a whole run."""
    assert not any(map(contradiction_so_far, followed(FIRST, 100, agreed, matched)))


def test_a_change_for_good_becomes_usual():
    """One of ten planes agrees from a frame on, for a hundred frames."""
    changed = followed(followed(FIRST, 40, 9)[-1], 100, 1)
    assert all(map(contradiction_so_far, changed[8:50])) and not any(map(contradiction_so_far, changed[90:]))


def test_frames_with_few_planes_are_not_counted():
    """Of five planes four are matched wrongly, the same for sixty frames, after forty with ten that agree."""
    clean = followed(FIRST, 40, 10)[-1]
    few = followed(clean, 60, 1, matched=5)
    assert not any(map(contradiction_so_far, few)) and np.array_equal(few[-1].plane_counts, clean.plane_counts)
