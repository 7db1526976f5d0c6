"""Planes that lie elsewhere than in the map, by more than usual, are a contradiction."""

import dataclasses

import numpy as np
import pytest

from trihedron.pipeline.core.types import Planes, Pose
from trihedron.plugins.pose.judgement import judge_by_run
from trihedron.plugins.shared.contradiction import contradicting_depth, contradiction_so_far
from trihedron.plugins.shared.plane_offsets import plane_offset, with_plane_offsets

FIRST = Pose(0, 0, np.eye(4), np.eye(6), np.eye(4), -1, np.zeros(3, np.int32), 0, "ok", "")
WALLS = np.array([[0.0, 0.0, -1.0, 2.0], [0.0, 0.0, -1.0, 4.0]])  # 2 m and 4 m away, frontal
MATCHES = np.array([[0, 5], [1, 6]], np.int32)  # with two planes of a map
USUAL = 0.001  # of the distance; at 3.5 times that surfaces are another
EXACT = np.zeros((2, 4))  # m, by the calibration, of the samples of both


def planes_of(pixels=(2400, 2400)):
    """The two walls, each with so many of the 4800 pixels; one point less of the second."""
    samples = np.zeros((2, 8, 3), np.float32)
    samples[:, :, 2] = WALLS[:, 3:]
    samples[1, 7] = np.nan
    labels = np.zeros((60, 80), np.uint8)
    return Planes(0, 0, WALLS, np.tile(np.eye(3), (2, 1, 1)), np.tile(np.eye(4), (2, 1, 1)), np.array(pixels, np.int32), samples, labels, 1)


def followed(pose, frames, off, share=1.0):
    """The poses of so many frames, in each of which the planes are off by this share of their distance."""
    planes, poses = planes_of((int(2400 * share), int(2400 * share))), [pose]
    known = WALLS * [1.0, 1.0, 1.0, 1.0 + off]
    for _ in range(frames):
        poses.append(with_plane_offsets(poses[-1], poses[-1], known, planes, MATCHES, EXACT))
    return poses[1:]


def test_the_offset_is_that_of_half_of_the_area():
    """The first wall is 2 cm off at 2 m, the second 12 cm at 4 m."""
    known = WALLS + np.array([[0.0, 0.0, 0.0, 0.02], [0.0, 0.0, 0.0, 0.12]])
    assert plane_offset(known, planes_of((2400, 1200)), MATCHES, EXACT, USUAL) == pytest.approx((0.01, 0.75), abs=1e-6)
    assert plane_offset(known, planes_of((1200, 2400)), MATCHES, EXACT, USUAL) == pytest.approx((0.03, 0.75), abs=1e-6)
    assert plane_offset(known[1:], planes_of(), MATCHES[1:], EXACT[1:], USUAL) == pytest.approx((0.03, 0.5), abs=1e-6)
    samples = planes_of().samples_m.copy()
    samples[0, :4], samples[1] = 0.0, [1.0, np.inf, 4.0]  # no points
    strange = dataclasses.replace(planes_of(), samples_m=samples)
    assert plane_offset(known, strange, MATCHES, EXACT, USUAL) == pytest.approx((0.01, 0.5), abs=1e-6)
    assert plane_offset(known[:0], planes_of(), MATCHES[:0], EXACT[:0], USUAL) == (0.0, 0.0)


def test_what_the_calibration_explains_counts_less():
    """The walls are 2 cm off at 2 m and 12 cm at 4 m; 0.35 % of the distance would contradict the map. Where the calibration takes them 1 and 12 cm
    far, twice which is 1 and 6 % of their distance, they count that many times less; and where no keyframe had them in its image not at all."""
    known = WALLS + np.array([[0.0, 0.0, 0.0, 0.02], [0.0, 0.0, 0.0, 0.12]])
    sigmas_m = np.repeat([[0.01], [0.12]], 4, axis=1)
    assert plane_offset(known, planes_of((2400, 1200)), MATCHES, sigmas_m, USUAL) == pytest.approx((0.01 * 0.35, 0.75), abs=1e-6)
    assert plane_offset(known, planes_of((1200, 2400)), MATCHES, sigmas_m, USUAL) == pytest.approx((0.03 * 0.35 / 6.0, 0.75), abs=1e-6)
    assert plane_offset(known, planes_of((2400, 1200)), MATCHES, sigmas_m, 3.0 * USUAL) == pytest.approx((0.01, 0.75), abs=1e-6)
    sigmas_m[1] = np.nan
    assert plane_offset(known, planes_of(), MATCHES, sigmas_m, USUAL) == pytest.approx((0.01 * 0.35, 0.5), abs=1e-6)


def test_a_board_on_a_wall_is_no_offset_of_it():
    """A board 3 cm before a wall in 2 m, both matched with the plane of the wall: the wall counts. Matched alone, the board does, and so do pieces of
    the wall that lie within `apart` of each other."""
    planes, wall = planes_of((2400, 1200)), np.repeat(WALLS[:1], 2, axis=0)
    same = np.array([[0, 5], [1, 5]], np.int32)

    def with_second_at(distance):
        samples, coefficients = planes.samples_m.copy(), planes.coefficients.copy()
        samples[1, :, 2] *= distance / 4.0
        coefficients[1, 3] = distance
        return dataclasses.replace(planes, samples_m=samples, coefficients=coefficients)

    assert plane_offset(wall, with_second_at(1.97), same, EXACT, USUAL) == pytest.approx((0.0, 0.5), abs=1e-6)
    assert plane_offset(wall, with_second_at(1.97), same[::-1], EXACT, USUAL) == pytest.approx((0.0, 0.5), abs=1e-6)
    assert plane_offset(wall, with_second_at(1.97), MATCHES, EXACT, USUAL)[1] == pytest.approx(0.75)
    assert plane_offset(wall[1:], with_second_at(1.97), same[1:], EXACT[1:], USUAL) == pytest.approx((0.03 / 1.97, 0.25), abs=1e-6)
    assert plane_offset(wall, with_second_at(1.996), same, EXACT, USUAL) == pytest.approx((0.0, 0.75), abs=1e-6)
    assert plane_offset(wall + np.array([0.0, 0.0, 0.0, 0.1]), with_second_at(1.996), same, EXACT, USUAL) == pytest.approx((0.05, 0.75), abs=1e-6)


def test_planes_that_lie_elsewhere_than_usual_are_a_contradiction():
    """Half a per cent off for forty frames, and five from then on: seen in the third, and over with them."""
    clean = followed(FIRST, 40, 0.005)
    frozen = followed(clean[-1], 20, 0.05)
    after = followed(frozen[-1], 40, 0.005)
    assert not any(map(contradiction_so_far, clean))
    assert not any(map(contradiction_so_far, frozen[:2])) and all(map(contradiction_so_far, frozen[3:]))
    assert not any(map(contradiction_so_far, after[20:]))
    judged = judge_by_run(frozen[8], planes_agree=False)
    assert judged.status == "degraded"
    assert judged.reason == "planes contradict the map: of late they lie 3.3 % of their distance from where it has them, usually 0.6 %"


@pytest.mark.parametrize(("points", "disagreement", "contradicts"), [(100, 0.2, False), (99, 0.2, True), (100, 0.3, True)])
def test_points_that_agree_outweigh_planes(points, disagreement, contradicts):
    """Depth of points is measured, too: where a hundred of them, and three quarters of late, are where the map has them, planes that are not are no
    contradiction of depth and map."""
    off = followed(followed(FIRST, 40, 0.005)[-1], 20, 0.05)[-1]
    with_points = dataclasses.replace(off, inliers=np.array([points, 0, 0], np.int32), disagreement=disagreement)
    assert bool(contradicting_depth(with_points)) is contradicts and contradicting_depth(off)


@pytest.mark.parametrize("off", [0.0, 0.002, 0.05])
def test_what_is_usual_is_none(off):
    """Planes that are off by as much for a whole run, those of a miscalibrated camera among them."""
    assert not any(map(contradiction_so_far, followed(FIRST, 100, off)))


def test_what_is_less_than_a_sixth_of_a_per_cent_is_none():
    """Depth without errors, after which planes are off by 1.5 mm at a metre."""
    assert not any(map(contradiction_so_far, followed(followed(FIRST, 40, 0.0)[-1], 100, 0.0015)))


def test_a_change_for_good_becomes_usual():
    """Five per cent off from a frame on, after half a per cent: for more than two seconds at 30 images a second it is a contradiction."""
    changed = followed(followed(FIRST, 40, 0.005)[-1], 120, 0.05)
    assert all(map(contradiction_so_far, changed[3:80])) and not any(map(contradiction_so_far, changed[105:]))


def test_planes_count_by_their_area():
    """Walls in a hundredth of the image, off by five per cent for ten frames, hardly count; frames without any leave all as it is."""
    clean = followed(FIRST, 40, 0.005)[-1]
    few = followed(clean, 10, 0.05, share=0.01)
    assert not any(map(contradiction_so_far, few)) and few[-1].plane_offsets[0] < 0.006
    none = with_plane_offsets(clean, clean, WALLS[:0], planes_of(), MATCHES[:0], EXACT[:0])
    assert np.array_equal(none.plane_offsets, clean.plane_offsets)
