"""Dynamic objects: poses by matches on planes and by multi-view verified landmarks, where the others move."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import exp_se3, log_se3
from trihedron.plugins.matches.local_map import LocalMap
from trihedron.plugins.pose.dynamic_objects import (
    MIN_POINTS,
    Selection,
    StaticMatches,
    covariance_about,
    distance2,
    matches_on_planes,
    static_selections,
    status_with_static,
    verified_matches,
    verified_planes,
)
from trihedron.plugins.pose.judgement import with_disagreement
from trihedron.plugins.pose.map_alignment import InlierStatistics, MapAlignment, TrackingStatus
from trihedron.plugins.pose.refine import Refine
from trihedron.plugins.shared.pose_optimizer import PoseSolution
from trihedron.plugins.shared.residuals_kernels import LineTerms, PointTerms

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import World, camera_at, rotation_of, translation_of
from map_steps import EVERY, pose_of, walk
from test_pose import OFF, error

STEP = 8  # of the camera's path, where the map of steps 0 … 6 is looked for
SWAY = np.array([0.02, 0.01, 0.0])  # m, what moves has gone


@pytest.fixture(scope="module")
def world():
    return World(2000)


@pytest.fixture(scope="module")
def map(world):
    return walk(world, 4, EVERY, stride=2)


@pytest.fixture(scope="module")
def single(world):
    """Of one keyframe, a step away."""
    return walk(world, 1, EVERY, stride=2)


def matched(world, map):
    """The features of a frame, and its matches from a decoupled pose 3 cm and half a degree off."""
    guess, features = camera_at(STEP) @ exp_se3(OFF), world.features(camera_at(STEP), STEP)
    start = rotation_of(guess, STEP, 0.5), translation_of(guess, STEP, sigma_m=0.03)
    return start, features, LocalMap()(world.frame(STEP).camera, *start, *features, map, None)


def with_movers(map, matches, share, shift_m):
    """The map in which a share of the points that are matched were met once, and have moved since."""
    ids = matches.keypoints[:, 1]
    ids = ids[np.random.default_rng(0).random(len(ids)) < share]
    place = map.points.rows("position_m", ids) + shift_m
    return dataclasses.replace(map, points=map.points.updated(ids, position_m=place, found=np.ones(len(ids), np.int32)))


def refined(world, map, share, shift_m=SWAY, **options):
    start, features, matches = matched(world, map)
    moved = with_movers(map, matches, share, shift_m)
    return Refine(**options)(world.frame(STEP).camera, *start, None, matches, *features, pose_of(camera_at(STEP - 1), STEP - 1), moved, None)


def test_a_landmark_that_two_keyframes_measured_is_proven(world, map):
    _, _, matches = matched(world, map)
    found = verified_matches(map, matches)
    for ids, known, table, kind in (
        (matches.keypoints[:, 1], found.points, map.point_observations, "point"),
        (matches.segments[:, 1], found.lines, map.line_observations, "line"),
    ):
        seen = np.bincount(table.column(kind), minlength=ids.max() + 1)[ids]
        assert (seen[known] >= 2).all() and (known == (seen >= 2)).mean() > 0.98  # two rows of one corner that became one were seen once each
    points, lines, planes = found.select((PointTerms(*[matches.keypoints] * 6), LineTerms(*[matches.segments] * 6), matches.planes))
    assert all(np.array_equal(column, matches.keypoints[found.points]) for column in points) and planes is matches.planes
    assert all(np.array_equal(column, matches.segments[found.lines]) for column in lines)


def test_what_lies_within_planes_that_are_matched_is_at_rest(world, map):
    _, (keypoints, segments, planes), matches = matched(world, map)
    found = matches_on_planes(matches, keypoints, segments, planes)
    rows = matches.keypoints[:, 0]
    points, normals = keypoints.points_m[rows].astype(float), planes.coefficients[:, :3]
    nearest_m = np.abs(points @ normals.T + planes.coefficients[:, 3]).min(axis=1)
    assert found.points.sum() > 100 and np.nanmax(nearest_m[found.points]) < 0.1
    fewer = dataclasses.replace(matches, planes=matches.planes[:1])
    less, label = matches_on_planes(fewer, keypoints, segments, planes), matches.planes[0, 0] + 1
    at = np.rint(keypoints.pixels[rows] / planes.stride).astype(int)
    assert (planes.labels[at[less.points, 1], at[less.points, 0]] == label).all() and not (less.points & ~found.points).any()
    border = dataclasses.replace(planes, labels=np.where(np.indices(planes.labels.shape).sum(0) % 3 == 0, 0, planes.labels).astype(np.uint8))
    assert not matches_on_planes(matches, keypoints, segments, border).points.any()  # something else within a cell of each
    assert [kind.selection for kind in static_selections(map, matches, keypoints, segments, planes)] == [Selection.ON_PLANES, Selection.VERIFIED]


def test_a_plane_met_once_is_not_known_to_be_at_rest_unless_there_is_but_one_keyframe(world, map, single):
    matches = matched(world, map)[2]
    young = dataclasses.replace(map, planes=map.planes.updated(matches.planes[:1, 1], found=np.array([1])))
    assert verified_planes(map, matches).all() and verified_planes(single, matched(world, single)[2]).all()
    assert np.array_equal(verified_planes(young, matches), matches.planes[:, 1] != matches.planes[0, 1])


def denied(world, map, points, planes):
    """Return True if a pose by matches on planes is degraded, when so many of the points and planes agree with it."""
    (rotation, _), features, matches = matched(world, map)
    problem = MapAlignment(Refine(), rotation.R_world_camera, np.eye(6), world.frame(STEP).camera, matches, *features, map)
    counts = (len(matches.keypoints), int(points * len(matches.keypoints))), (len(matches.segments), 0), (len(matches.planes), planes)
    flags = [(np.arange(count) < agree).astype(np.uint8) for count, agree in counts]
    found = PoseSolution(camera_at(STEP), 1e-6 * np.eye(6), np.empty((6, 0)), *flags, 0.0)
    status = status_with_static(TrackingStatus("ok", ""), found, problem, Selection.ON_PLANES, Refine())
    assert status.status == "ok" or status.reason.startswith("something moves")
    return status.status == "degraded"


def test_a_pose_by_what_lies_on_planes_is_denied_by_most_of_what_is_seen_and_half_of_the_planes(world, map):
    assert denied(world, map, 0.2, 1)
    assert not denied(world, map, 0.9, 1) and not denied(world, map, 0.2, 3)


def test_new_points_contradict_proven_ones_by_the_difference_of_their_shares():
    known = StaticMatches(Selection.VERIFIED, np.arange(200) < 100, np.empty(0, bool))
    agree = np.ones(200, np.uint8)
    assert known.outlier_difference(agree) == 0.0
    agree[:10], agree[100:140] = 0, 0  # 10 % of the proven, 40 % of the new
    others = StaticMatches(Selection.VERIFIED, ~known.points, known.lines)
    assert known.outlier_difference(agree) == pytest.approx(0.3) and others.outlier_difference(agree) == pytest.approx(0.3)
    assert StaticMatches(Selection.VERIFIED, np.arange(200) < MIN_POINTS - 1, known.lines).outlier_difference(agree) == 0.0


def test_the_distance_is_in_standard_deviations_of_the_first():
    sigma = np.array([0.01, 0.02, 0.04, 0.001, 0.002, 0.004])
    none = np.empty(0, np.uint8)
    first = PoseSolution(camera_at(3), np.diag(sigma**2), np.empty((6, 0)), none, none, none, 0.0)
    other = dataclasses.replace(first, T_world_camera=camera_at(3) @ exp_se3(2.0 * sigma), covariance=1e6 * np.eye(6))
    assert distance2(first, other) == pytest.approx(24.0, rel=0.01) and distance2(first, first) < 1e-12


def test_a_pose_that_most_contradicts_is_known_no_better_than_the_other_one_and_lies_within():
    none = np.empty(0, np.uint8)
    said = PoseSolution(camera_at(3), 1e-8 * np.eye(6), np.empty((6, 0)), none, none, none, 0.0)
    sure = dataclasses.replace(said, T_world_camera=camera_at(3) @ exp_se3(OFF), covariance=1e-6 * np.eye(6))
    spread = covariance_about(said, sure)
    assert OFF @ np.linalg.solve(spread, OFF) < 1.0 and np.linalg.eigvalsh(spread)[0] > 0.99e-6


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_what_moves_does_not_pull_the_pose(world, map, share):
    pose, pulled = refined(world, map, share), refined(world, map, share, moving_gate=1e9)
    still = refined(world, map, share, np.zeros(3))
    print(f"{share:.0%} moving: {error(pose, STEP)}, all alike {error(pulled, STEP)}, at rest {error(still, STEP)} (m, deg)")
    assert error(pose, STEP)[0] < 0.006 and pose.status == "ok" and pose.reason.endswith("by verified landmarks alone")
    assert error(pulled, STEP)[0] > 2.0 * error(pose, STEP)[0]


def test_where_most_contradicts_what_is_proven_the_pose_is_degraded(world, map):
    pose = refined(world, map, 0.75, 2.5 * SWAY)
    assert pose.status == "degraded" and "something moves" in pose.reason


def test_new_points_at_rest_count_like_the_others(world, map):
    pose, alike = refined(world, map, 0.5, np.zeros(3)), refined(world, map, 0.5, np.zeros(3), moving_share=1.0, moving_gate=1e9)
    assert np.array_equal(pose.T_world_camera, alike.T_world_camera) and pose.reason == alike.reason and pose.status == "ok"


@pytest.mark.parametrize("field", ["moving_share", "moving_gate", "moving_sure", "moving_unproven"])
def test_ranges_are_checked(field):
    with pytest.raises(ValueError, match=field):
        Refine(**{field: 0.0})


def judged(world, single, share, **options):
    """A pose by the map of one keyframe, and its squared error in standard deviations."""
    pose = refined(world, single, share, 2.0 * SWAY, **options)
    xi = log_se3(invert(pose.T_world_camera) @ camera_at(STEP))
    return pose, float(xi @ np.linalg.solve(pose.covariance, xi))


def test_while_nothing_is_proven_the_planes_tell_what_moves(world, single):
    (pose, squared), (pulled, beyond) = judged(world, single, 0.6), judged(world, single, 0.6, moving_unproven=1e9)
    print(f"by the planes {error(pose, STEP)} ({squared:.1f}), by all {error(pulled, STEP)} ({beyond:.1f}) (m, deg); {pose.reason}")
    assert pose.status == "degraded" and pose.reason.endswith("agree with the planes") and squared < 24.0
    assert pulled.reason.startswith("most points contradict the map: of late ") and beyond > 24.0
    assert error(pulled, STEP)[0] > 3.0 * error(pose, STEP)[0]


def test_where_most_denies_all_that_is_seen_the_pose_is_known_no_better_than_planes_say(world, single):
    pose, squared = judged(world, single, 0.6, moving_unproven=1e9, moving_most=0.6)  # the planes are not asked what moves
    assert pose.status == "degraded" and pose.reason.startswith("something moves") and squared < 24.0


def test_at_rest_one_keyframe_is_enough(world, single):
    pose, squared = judged(world, single, 0.0)
    assert pose.status == "ok" and "alone" not in pose.reason and squared < 24.0


def in_motion(world, map, off_px, blur_px):
    """The pose of a camera whose key points are off by so much at random, in an image blurred by `blur_px`."""
    start, (keypoints, *others), matches = matched(world, map)
    off = off_px * np.random.default_rng(0).normal(size=keypoints.pixels.shape)
    pixels = (keypoints.pixels + off).astype(np.float32)
    blurred = dataclasses.replace(keypoints, pixels=pixels, sigma_px=np.hypot(keypoints.sigma_px, np.float32(blur_px)), blur_px=blur_px)
    before = pose_of(camera_at(STEP - 1), STEP - 1)
    return Refine()(world.frame(STEP).camera, *start, None, matches, blurred, *others, before, map, None)


def test_blur_is_no_contradiction_and_the_reason_names_it(world, map):
    """Points of a blurred image are pixels off without anything that moves; in a sharp one most of them contradict the pose."""
    blurred, sharp = in_motion(world, map, 4.0, 4.0), in_motion(world, map, 4.0, 0.0)
    assert blurred.status == "ok" and blurred.reason.endswith("; the image is blurred by 4.0 px: turn slower")
    assert sharp.inliers[0] < 0.5 * blurred.inliers[0] and sharp.status == "degraded"
    assert error(blurred, STEP)[0] < 0.01 and "blurred" not in sharp.reason


def test_what_disagrees_for_long_is_a_contradiction(world, map):
    """A frame of which most agrees, after ten of which less than half did; and after ten of which a little more did."""
    start, features, matches = matched(world, map)
    before = dataclasses.replace(pose_of(camera_at(STEP - 1), STEP - 1), disagreement=0.57)
    poses = [
        Refine()(world.frame(STEP).camera, *start, None, matches, *features, dataclasses.replace(before, disagreement=share), map, None)
        for share in (0.57, 0.5)
    ]
    share = poses[0].inliers[0] / len(matches.keypoints)
    assert share > 0.9 and poses[0].disagreement == pytest.approx(0.57 + (1.0 - share - 0.57) / 10)
    assert poses[0].status == "degraded"
    assert poses[0].reason == f"most points contradict the map: of late {100 * poses[0].disagreement:.0f} % of the matched ones disagree"
    assert poses[1].status == "ok" and 0.44 < poses[1].disagreement < 0.5


@pytest.mark.parametrize("matched_points, static, expected", [(200, None, 0.6), (99, None, 0.0), (200, Selection.PLANES, 0.0)])
def test_the_first_frame_begins_the_average_of_what_disagrees(matched_points, static, expected):
    """Colour that is shuffled from the first frame on would be taken for agreement for seven frames; with a pose by planes alone, what disagrees may
    move."""
    inliers = InlierStatistics((round(0.4 * matched_points), 0, 0), (matched_points, 0, 0))
    first = pose_of(np.eye(4), 0)
    assert with_disagreement(first, first, inliers, static).disagreement == pytest.approx(expected)


def test_what_contradicts_is_not_continued_without_the_map(world, map):
    """A frame that hardly matches the map, after one whose planes contradicted colour and after one whose did not: it is lost."""
    start, features, matches = matched(world, map)
    kinds = "keypoints", "segments", "planes", "parallel", "perpendicular"
    few = dataclasses.replace(matches, **{kind: getattr(matches, kind)[:1] for kind in kinds})
    before = pose_of(camera_at(STEP - 1), STEP - 1)
    lost, continued = (
        Refine()(world.frame(STEP).camera, *start, None, few, *features, dataclasses.replace(before, plane_offsets=offsets), map, None)
        for offsets in (np.array([0.02, 0.005, 60.0]), np.array([0.006, 0.005, 60.0]))
    )
    doubt = "planes contradict the map: of late they lie 2.0 % of their distance from where it has them, usually 0.5 %"
    assert (lost.status, lost.reason) == ("lost", f"{doubt}; and now only 3 of 3 matches with the map agree") and lost.plane_offsets[0] == 0.02
    assert continued.status == "degraded"


def test_planes_that_contradict_the_map_do_not_tie_a_frame_to_it(world, map):
    """A frame that matches three planes, one point and one line, after one whose planes contradicted the map and after one whose did not."""
    start, features, matches = matched(world, map)
    few = dataclasses.replace(matches, keypoints=matches.keypoints[:1], segments=matches.segments[:1])
    before = pose_of(camera_at(STEP - 1), STEP - 1)
    lost, continued = (
        Refine()(world.frame(STEP).camera, *start, None, few, *features, dataclasses.replace(before, plane_offsets=offsets), map, None)
        for offsets in (np.array([0.02, 0.005, 60.0]), np.array([0.006, 0.005, 60.0]))
    )
    assert lost.status == "lost" and lost.reason.endswith("usually 0.5 %; and now only 5 of 5 matches with the map agree")
    assert continued.status != "lost"


def test_a_jump_needs_the_map(world, map):
    """A frame to which the camera moved back at 30 m/s after it had gone on: with all matches, and with one of each kind, by which the map would go
    on from anywhere."""
    start, features, matches = matched(world, map)
    few = dataclasses.replace(matches, keypoints=matches.keypoints[:1], segments=matches.segments[:1])
    carried, twist = np.array([10.0, 1.0, 1.0]), np.array([-30.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    before = dataclasses.replace(pose_of(camera_at(STEP - 1), STEP - 1), twist=twist, usual_accelerations=carried)
    found, lost = (Refine()(world.frame(STEP).camera, *start, None, some, *features, before, map, None) for some in (matches, few))
    assert found.status == "degraded" and found.reason.startswith("a jump: the motion since the previous frame takes ")
    assert lost.status == "lost" and lost.lost_from == STEP
    assert lost.reason == "the camera jumped, and the map does not determine the pose by itself: only 5 of 5 matches agree"


def test_what_was_mapped_before_the_camera_was_lost_is_still_there(world, map):
    """A frame that matches what it should of the map, and one that matches a tenth of it, after a loss in frame 7 and after none."""
    start, features, matches = matched(world, map)
    tenth = dataclasses.replace(matches, keypoints=matches.keypoints[::10])
    before = dataclasses.replace(pose_of(camera_at(STEP - 1), STEP - 1), lost_from=7, missing=0.96, confirmations=3)

    def refined(found, previous):
        return Refine()(world.frame(STEP).camera, *start, None, found, *features, previous, map, None)

    known, other, never = refined(matches, before), refined(tenth, before), refined(tenth, pose_of(camera_at(STEP - 1), STEP - 1))
    print(known.missing, other.missing, len(matches.visible_points), len(matches.keypoints))
    assert known.status == "ok" and known.missing < 0.95 and known.lost_from == 7
    assert other.status == "degraded" and other.missing > 0.95
    missing = f"of late {100 * other.missing:.0f} % of what was mapped before and should be seen is missing"
    assert other.reason == f"the camera was lost or jumped in frame 7, and found again in a place that looks the same: {missing}"
    assert never.status == "ok" and (never.lost_from, never.missing) == (0, 0.0)
