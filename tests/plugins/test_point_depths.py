"""Points that the image shows where the map has them, but elsewhere in depth, are a contradiction of both."""

import dataclasses

import numpy as np
import pytest

from trihedron.pipeline.core.types import Camera, Pose
from trihedron.plugins.pose.judgement import judge_by_run
from trihedron.plugins.shared.contradiction import contradicting_depth, contradiction_so_far, with_averages_of
from trihedron.plugins.shared.point_depths import with_depth_disagreement
from trihedron.plugins.shared.pose_optimizer import classify_terms
from trihedron.plugins.shared.residuals_kernels import PointTerms

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
FIRST = Pose(0, 0, np.eye(4), np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", "")
COUNT = 100


def points(off_in_depth=0, off_in_pixels=0, without_depth=0, count=COUNT):
    """Points of the map 2 m away and where an image shows them: the first ones 20 cm off in depth, the last ones 20 px off, and before these some
    without depth."""
    rng = np.random.default_rng(1)
    positions_m = np.column_stack([rng.uniform(-1.0, 1.0, (count, 2)), np.full(count, 2.0)])
    pixels = positions_m[:, :2] / positions_m[:, 2:] * 500.0 + [319.5, 239.5]
    pixels[count - off_in_pixels :] += 20.0
    depth_m = np.full(count, 2.0)
    depth_m[:off_in_depth] += 0.2
    depth_m[count - off_in_pixels - without_depth : count - off_in_pixels] = np.nan
    return PointTerms(positions_m, np.tile(1e-6 * np.eye(3), (count, 1, 1)), pixels, depth_m, np.full(count, 0.6), np.full(count, 0.01))


def followed(pose, frames, terms):
    """The poses of so many frames, each of which shows these points."""
    poses, agreeing = [pose], classify_terms(FIRST.T_world_camera, CAMERA, terms).points
    for _ in range(frames):
        poses.append(with_depth_disagreement(poses[-1], poses[-1], CAMERA, terms, agreeing))
    return poses[1:]


def test_the_share_is_of_the_points_that_the_image_shows_where_they_are():
    """20 of 60; 19 lie elsewhere in the image, as what moves does, and 21 have no depth."""
    pose = followed(FIRST, 1, points(off_in_depth=20, off_in_pixels=19, without_depth=21))[0]
    assert (pose.depth_disagreement, pose.usual_depth_disagreement) == pytest.approx((1.0 / 3.0, 1.0 / 3.0))


def test_few_points_leave_it_as_it_is():
    pose = dataclasses.replace(FIRST, depth_disagreement=0.1, usual_depth_disagreement=0.05)
    few = followed(pose, 1, points(off_in_depth=40, without_depth=51))[0]
    assert (few.depth_disagreement, few.usual_depth_disagreement) == (0.1, 0.05)
    lost = with_averages_of(pose, FIRST)
    assert (lost.depth_disagreement, lost.usual_depth_disagreement) == (0.1, 0.05)


def test_depth_of_another_view_is_a_contradiction_in_the_second_frame():
    """2 % for forty frames, as by chance, then half of them for twenty, and 2 % again."""
    clean = followed(FIRST, 40, points(off_in_depth=2))
    frozen = followed(clean[-1], 20, points(off_in_depth=50))
    after = followed(frozen[-1], 20, points(off_in_depth=2))
    assert not any(map(contradiction_so_far, clean))
    assert not contradiction_so_far(frozen[0]) and all(map(contradicting_depth, frozen[1:]))
    assert not any(map(contradiction_so_far, after[4:]))
    judged = judge_by_run(frozen[1], planes_agree=True)
    assert judged.status == "degraded"
    assert judged.reason == (
        "colour and depth contradict each other: of late 29 % of the points lie where the image shows them, but elsewhere in depth, usually 3 %"
    )


@pytest.mark.parametrize("off", [0, 16, 50])
def test_what_is_usual_is_none(off):
    """As many for a whole run, and half as many again for a moment: as of a camera whose depth is not registered well."""
    clean = followed(FIRST, 60, points(off_in_depth=off))
    assert not any(map(contradiction_so_far, [*clean, *followed(clean[-1], 3, points(off_in_depth=off * 3 // 2))]))


def test_what_moves_is_none():
    """Half of the points lie elsewhere in the image; or a third, and as many where the image shows them, but elsewhere in depth."""
    assert not any(map(contradicting_depth, followed(FIRST, 60, points(off_in_pixels=50))))
    clean = followed(FIRST, 40, points(off_in_depth=2))[-1]
    moving = followed(clean, 20, points(off_in_depth=33, off_in_pixels=33))
    assert not any(map(contradicting_depth, moving)) and moving[-1].usual_depth_disagreement > 0.08
    assert contradicting_depth(followed(clean, 20, points(off_in_depth=33, off_in_pixels=32))[-1])
