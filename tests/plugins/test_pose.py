"""The pose stage: refinement against a map that is known, and what is said when there is little to say."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.geometry import invert
from trihedron.pipeline.core.lie import exp_se3, exp_so3, log_se3, rotation_angle_deg
from trihedron.pipeline.core.types import Pose
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.matches.local_map import LocalMap
from trihedron.plugins.pose.judgement import is_tracked, judge_by_run, repeated_images, since_loss
from trihedron.plugins.pose.map_alignment import InlierStatistics
from trihedron.plugins.pose.none import NoRefinement
from trihedron.plugins.pose.refine import Refine
from trihedron.plugins.shared.calibration_error import calibration_covariance

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import World, camera_at, rotation_of, tracks_of, translation_of

OFF = np.array([0.02, -0.015, 0.02, 0.005, -0.006, 0.004])  # of the decoupled pose: 3 cm and half a degree
KINDS = {"points": "keypoints", "lines": "segments", "planes": "planes"}


def pose_of(T, index, status="ok"):
    return Pose(index, index * 33_000_000, T, np.eye(6) * 1e-8, T, -1, np.zeros(3, np.int32), 0, status, "")


def first_map(world):
    return Covisibility()(world.frame(0), pose_of(np.eye(4), 0), *world.features(np.eye(4), 0), None, None, None, None, None)


def refined(world, map, step=5, off=OFF, keep=tuple(KINDS), stage=None, **changes):
    """The pose of the frame at `step` from a decoupled one moved by `off`, with the matches of the kinds `keep`."""
    guess = camera_at(step) @ exp_se3(np.asarray(off, float))
    rotation, translation = rotation_of(guess, step, 0.5), translation_of(guess, step, sigma_m=0.03)
    features = world.features(camera_at(step), step)
    matches = LocalMap()(world.frame(step).camera, rotation, translation, *features, map, None)
    if matches is not None:
        dropped = {name: getattr(matches, name)[:0] for kind, name in KINDS.items() if kind not in keep}
        if "planes" not in keep:
            dropped.update(parallel=dropped["planes"], perpendicular=dropped["planes"])
        matches = dataclasses.replace(matches, **dropped)
    stage, given = stage or Refine(), {"previous": pose_of(camera_at(step - 1), step - 1), "relocalise": None, "matches": matches, **changes}
    return stage(world.frame(step).camera, rotation, translation, None, given["matches"], *features, given["previous"], map, given["relocalise"])


def error(pose, step=5):
    D = invert(camera_at(step)) @ pose.T_world_camera
    return np.linalg.norm(D[:3, 3]), rotation_angle_deg(D[:3, :3])


@pytest.mark.parametrize(
    "keep, limit_m, limit_deg", [(("points", "lines", "planes"), 0.003, 0.06), (("points",), 0.012, 0.2), (("planes",), 0.006, 0.12)]
)
def test_the_pose_is_found_from_any_kind(keep, limit_m, limit_deg):
    worlds = [World(2000, seed) for seed in range(10)]
    errors = np.array([error(refined(world, first_map(world), keep=keep)) for world in worlds])
    rms = np.sqrt((errors**2).mean(axis=0))
    assert rms[0] < limit_m and rms[1] < limit_deg  # of 3.2 cm and 0.5 degrees


def test_lines_alone_improve_what_they_see():
    """A score of segments, each seen once before."""
    worlds = [World(seed=seed) for seed in range(10)]
    errors = np.array([error(refined(world, first_map(world), keep=("lines",))) for world in worlds])
    assert np.median(errors[:, 0]) < 0.8 * np.linalg.norm(OFF[:3]) and np.median(errors[:, 1]) < 0.25


def test_exact_data_give_the_exact_pose():
    world = World(noise=0.0)
    metres, degrees = error(refined(world, first_map(world)))
    assert metres < 3e-4 and degrees < 0.005


def test_the_covariance_is_honest():
    """Normalised error squared over 60 maps and decoupled poses drawn from what is said of them; 6 in the mean, ±2.2 is five standard deviations.

    This camera's calibration is exact, which the pose cannot know: what it counts for that is left out."""
    errors = []
    for seed in range(60):
        rng, world = np.random.default_rng(seed), World(seed=seed)
        off = rng.normal(size=6) * [0.02, 0.02, 0.02, *np.full(3, np.radians(0.5))]
        pose = refined(world, first_map(world), off=off)
        xi = log_se3(invert(pose.T_world_camera) @ camera_at(5))
        errors.append(xi @ np.linalg.solve(pose.covariance - calibration_covariance(pose), xi))
    assert abs(np.mean(errors) - 6.0) < 2.2


def walked_map(world, steps):
    """The map after frames of which every one is a keyframe."""
    stage, map = Covisibility(min_frames=1, max_frames=1, min_shift=1e-3), None
    for step in steps:
        T, features = camera_at(step), world.features(camera_at(step), step)
        matches = LocalMap()(world.frame(step).camera, rotation_of(T, step), translation_of(T, step), *features, map, None)
        map = stage(world.frame(step), pose_of(T, step), *features, matches, map, None, None, None) or map
    return map


@pytest.mark.parametrize("steps, share", [((0,), 0.0), ((0, 15, 30, 45), 0.1)])
def test_covariances_in_the_world_scale_with_the_noise_that_residuals_show(steps, share):
    """The scale that the residuals show is averaged over ten frames; landmarks of one keyframe show none, and the previous scale stays."""
    world = World()
    map, poses, step = walked_map(world, steps), {}, steps[-1] + 2
    for scale in (2.0, 3.0):
        poses[scale] = refined(world, map, step, previous=dataclasses.replace(pose_of(camera_at(step - 1), step - 1), noise_scale=scale))
    shown = [pose.noise_scale - (1.0 - share) * scale for scale, pose in poses.items()]  # `share` times the scale of this frame alone
    assert shown[0] == pytest.approx(shown[1], abs=1e-12) and (shown[0] > 0.01 if share else abs(shown[0]) < 1e-12)
    measured = [(pose.covariance - pose.map_covariance) / pose.noise_scale for pose in poses.values()]
    np.testing.assert_allclose(measured[0], measured[1], rtol=1e-9, atol=1e-15)
    assert poses[3.0].noise_scale > 1.2 * poses[2.0].noise_scale > 2.0


def test_a_pose_says_its_keyframe_and_what_it_rests_on():
    world = World()
    map = first_map(world)
    pose = refined(world, map)
    assert pose.status == "ok" and pose.reference == 0 and pose.unobservable == 0
    assert np.allclose(map.keyframes.column("T_world_camera")[0] @ pose.T_reference_camera, pose.T_world_camera)
    assert pose.inliers[0] > 30 and pose.inliers[2] == 3
    assert pose.reason == "{} points, {} lines and {} planes of the map".format(*pose.inliers)


def test_the_first_frame_is_the_identity_and_ok():
    world = World()
    rotation, translation = rotation_of(np.eye(4), 0), translation_of(np.eye(4), 0)
    for pose in (
        Refine()(world.frame(0).camera, rotation, translation, None, None, *world.features(np.eye(4), 0), None, None, None),
        NoRefinement()(rotation, translation, None, None, None),
    ):
        assert pose.status == "ok" and pose.reference == -1
        assert np.array_equal(pose.T_world_camera, np.eye(4)) and np.linalg.eigvalsh(pose.covariance).min() > 0.0


def test_without_a_map_the_decoupled_pose_stands():
    world = World()
    pose = refined(world, None)
    guess = camera_at(5) @ exp_se3(OFF)
    assert np.allclose(pose.T_world_camera, guess) and np.allclose(pose.T_reference_camera, guess)
    assert pose.status == "ok" and pose.reference == -1 and list(pose.inliers) == [50, 5, 3]


@pytest.mark.parametrize(
    "source, estimated, held, status, reason",
    [
        ("manhattan", True, 0, "ok", "50 points, 5 lines and 3 planes of the previous frame"),
        ("prediction", True, 0, "degraded", "the rotation was predicted, not measured"),
        ("manhattan", True, 1, "degraded", "1 directions of motion are unobservable, held at the prediction"),
        ("manhattan", False, 3, "lost", "no feature of the previous frame was matched"),
    ],
)
def test_the_status_of_a_decoupled_pose(source, estimated, held, status, reason):
    world, T = World(), camera_at(3)
    translation = dataclasses.replace(translation_of(T, 3, estimated=estimated), unobservable=np.eye(3)[:held].copy())
    rotation = rotation_of(T, 3, source=source)
    for pose in (
        NoRefinement()(rotation, translation, pose_of(T, 2), None, None),
        Refine()(world.frame(3).camera, rotation, translation, None, None, *world.features(T, 3), pose_of(T, 2), None, None),
    ):
        assert (pose.status, pose.reason, pose.unobservable) == (status, reason, held)
        assert np.array_equal(pose.T_world_camera, T)


def test_when_nothing_of_the_map_is_found_the_pose_is_degraded():
    world = World()
    pose = refined(world, first_map(world), keep=())
    assert pose.status == "degraded" and pose.reason == "nothing of the map was found, pose from the previous frame"
    assert pose.reference == 0 and np.allclose(pose.T_world_camera, camera_at(5) @ exp_se3(OFF))


def test_matches_that_contradict_each_other_are_not_called_ok():
    world = World(noise=0.0)
    map = first_map(world)
    guess = camera_at(5) @ exp_se3(OFF)
    matches = LocalMap()(world.frame(5).camera, rotation_of(guess, 5), translation_of(guess, 5), *world.features(camera_at(5), 5), map, None)
    pairs = matches.keypoints.copy()
    pairs[:, 1] = np.random.default_rng(0).permutation(pairs[:, 1])
    none = matches.planes[:0]
    wrong = dataclasses.replace(matches, keypoints=pairs, segments=none, planes=none, parallel=none, perpendicular=none)
    pose = refined(world, map, matches=wrong)
    assert pose.status == "degraded" and error(pose)[0] < 0.1


def test_too_small_a_share_of_inliers_degrades_a_pose():
    """Of noisy matches a few are beyond their gates: not all agree."""
    world = World(2000)
    map = first_map(world)
    pose = refined(world, map)
    strict = refined(world, map, stage=Refine(min_share=1.0, found_share=1.0))
    assert pose.status == "ok" and np.array_equal(pose.T_world_camera, strict.T_world_camera) and np.array_equal(pose.inliers, strict.inliers)
    words = strict.reason.split()
    assert strict.status == "degraded" and strict.reason == f"only {pose.inliers.sum()} of {words[3]} matches with the map agree"
    assert int(words[3]) > pose.inliers.sum()


@pytest.mark.parametrize(
    "inliers, matched, tracked",
    [((20, 0, 0), (40, 0, 0), True), ((19, 0, 0), (40, 0, 0), False), ((0, 0, 2), (0, 0, 4), True), ((9, 0, 0), (9, 0, 0), False)],
)
def test_a_tracked_pose_needs_a_number_and_a_share_of_inliers(inliers, matched, tracked):
    """At least ten, of points + 2 lines + 5 planes, and half of the matches."""
    assert is_tracked(Refine(min_share=0.5), InlierStatistics(inliers, matched)) is tracked


def test_a_rotation_that_was_not_measured_needs_the_map():
    """A camera that is somewhere else from one frame to the next: a handful of matches by chance is no place."""
    world = World(noise=0.0)
    map, features = first_map(world), world.features(camera_at(5), 5)
    guess = camera_at(5) @ exp_se3(OFF)
    matches = LocalMap()(world.frame(5).camera, rotation_of(guess, 5), translation_of(guess, 5), *features, map, None)
    pairs, none = matches.keypoints.copy(), matches.planes[:0]
    pairs[:, 1] = np.random.default_rng(0).permutation(pairs[:, 1])
    wrong = dataclasses.replace(matches, keypoints=pairs, segments=none, planes=none, parallel=none, perpendicular=none)
    previous = pose_of(camera_at(4), 4)
    for found, status in ((wrong, "lost"), (matches, "degraded")):
        rotation = rotation_of(guess, 5, 0.5, source="prediction")
        pose = Refine()(world.frame(5).camera, rotation, translation_of(guess, 5, sigma_m=0.03), None, found, *features, previous, map, None)
        assert pose.status == status and ("not measured" in pose.reason)


def test_a_jump_that_no_rotation_measured_is_verified_by_the_map_alone():
    """A predicted rotation that is ten standard deviations off: two walls turn it, and leave the camera's place along both unknown."""
    world = World(noise=0.0)
    map, features, previous = first_map(world), world.features(camera_at(5), 5), pose_of(camera_at(4), 4)
    guess = camera_at(5) @ exp_se3(np.array([0.0, 0.0, 0.0, 0.0, np.deg2rad(2.0), 0.0]))
    found = LocalMap()(world.frame(5).camera, rotation_of(guess, 5), translation_of(guess, 5), *features, map, None)
    none = found.keypoints[:0]
    walls = dataclasses.replace(found, keypoints=none, segments=none, planes=found.planes[:2], parallel=none, perpendicular=none)
    judged = []
    for matches, sigma_deg in ((walls, 0.2), (walls, 2.0), (found, 0.2)):
        rotation = rotation_of(guess, 5, sigma_deg, source="prediction")
        pose = Refine()(world.frame(5).camera, rotation, translation_of(guess, 5, sigma_m=0.03), None, matches, *features, previous, map, None)
        judged.append((pose.status, pose.reason))
    assert judged == [
        ("lost", "the rotation was not measured, the map turns it by 2°, and does not determine the pose by itself: only 2 of 2 matches agree"),
        ("degraded", "1 directions of motion are unobservable, held at the prediction"),
        ("degraded", "the rotation was predicted, not measured, before refinement"),
    ]


@pytest.mark.parametrize("tilt_deg, status", [(0.0, "ok"), (0.65, "degraded")])
def test_a_pose_by_walls_that_disagree_is_degraded(tilt_deg, status):
    """Three walls and no point: one of them is turned in the map, and the camera's place along its normal is known by it alone."""
    world = World(noise=0.0)
    map, features, guess = first_map(world), world.features(camera_at(5), 5), camera_at(5) @ exp_se3(OFF)
    rotation, translation = rotation_of(guess, 5, 0.5), translation_of(guess, 5, sigma_m=0.03)
    found = LocalMap()(world.frame(5).camera, rotation, translation, *features, map, None)
    none, wall = found.keypoints[:0], found.planes[:1, 1]
    walls = dataclasses.replace(found, keypoints=none, segments=none, planes=found.planes[:3], parallel=none, perpendicular=none)
    turned = map.planes.rows("coefficients", wall).copy()
    turned[0, :3] = exp_so3(np.deg2rad([0.0, tilt_deg, 0.0])) @ turned[0, :3]
    other = dataclasses.replace(map, planes=map.planes.updated(wall, coefficients=turned))
    pose = Refine()(world.frame(5).camera, rotation, translation, None, walls, *features, pose_of(camera_at(4), 4), other, None)
    reason = {"ok": "0 points, 0 lines and 3 planes of the map", "degraded": "planes alone observe 1 directions of motion, and disagree with the map"}
    assert (pose.status, pose.reason) == (status, reason[status])


def test_a_corridor_keeps_the_prediction_along_it():
    """Only one wall of the map is matched: the pose is corrected towards it, held along it, and called degraded."""
    world = World(noise=0.0)
    map = first_map(world)
    guess = camera_at(5) @ exp_se3(OFF)
    matches = LocalMap()(world.frame(5).camera, rotation_of(guess, 5), translation_of(guess, 5), *world.features(camera_at(5), 5), map, None)
    none = matches.keypoints[:0]
    one = dataclasses.replace(matches, keypoints=none, segments=none, planes=matches.planes[:1], parallel=none, perpendicular=none)
    pose = refined(world, map, matches=one)
    assert pose.status == "degraded" and pose.unobservable >= 2 and "held at the prediction" in pose.reason
    normal = map.planes.rows("coefficients", one.planes[:, 1])[0, :3]
    off = pose.T_world_camera[:3, 3] - camera_at(5)[:3, 3]
    assert abs(normal @ off) < 0.004 < np.linalg.norm(off - normal * (normal @ off))


def test_a_lost_pose_stays_lost_however_well_the_frames_fit_each_other():
    """The previous pose was lost and wrong by a metre; the tracks are good."""
    held = camera_at(2) @ exp_se3(np.array([1.0, 0, 0, 0, 0.3, 0]))
    guess = held @ invert(camera_at(2)) @ camera_at(3)
    found = NoRefinement()(rotation_of(guess, 3), translation_of(guess, 3), pose_of(held, 2, "lost"), None, None)
    assert found.status == "lost" and found.reason == "relocalisation failed since the pose was lost"
    assert np.allclose(found.T_world_camera, guess)


def test_a_place_recognised_replaces_a_lost_pose():
    world, held = World(), camera_at(2) @ exp_se3(np.array([1.0, 0, 0, 0, 0.3, 0]))
    lost, recognised = pose_of(held, 2, "lost"), pose_of(camera_at(5), 5)
    found = NoRefinement()(rotation_of(held, 5), translation_of(held, 5), lost, None, recognised)
    assert np.allclose(found.T_world_camera, camera_at(5)) and found.status == "ok"
    map, features = first_map(world), world.features(camera_at(5), 5)
    rotation, translation = rotation_of(held, 5), translation_of(held, 5)
    matches = LocalMap()(world.frame(5).camera, rotation, translation, *features, map, recognised)
    pose = Refine()(world.frame(5).camera, rotation, translation, None, matches, *features, lost, map, recognised)
    assert pose.status == "ok" and error(pose)[0] < 0.01


def test_a_lost_pose_is_found_again_near_the_prediction_by_the_map_alone():
    lost = pose_of(camera_at(4), 4, "lost")
    pose = refined(World(), first_map(World()), previous=lost)
    assert pose.status == "ok" and error(pose)[0] < 0.01


@pytest.mark.parametrize("lost_from, planes, ok", [(3, "yyyyyyyy", "-----y-y"), (3, "yyyynyyy", "--------"), (0, "nnnnnnnn", "yy-yyy-y")])
def test_a_place_that_was_found_again_is_ok_in_the_third_frame_in_a_row(lost_from, planes, ok):
    """After a loss: two frames that are ok by themselves, one that is not, three that are, one that is not, one that is. Frames with which most of
    their planes do not agree confirm nothing. Without a loss there is nothing to confirm."""
    pose, statuses = dataclasses.replace(pose_of(camera_at(4), 4, "lost" if lost_from else "ok"), lost_from=lost_from), ""
    for index, (status, agree) in enumerate(zip("yy-yyy-y", planes), 5):
        alone = pose_of(camera_at(index), index, "ok" if status == "y" else "degraded")
        pose = judge_by_run(since_loss(alone, pose), planes_agree=agree == "y")
        statuses += "y" if pose.status == "ok" else "-"
    assert statuses == ok


@pytest.mark.parametrize("keep", [("planes",), ()])
def test_too_little_of_the_map_leaves_a_lost_pose_lost(keep):
    """Three walls fix a pose, but any room has three walls."""
    pose = refined(World(), first_map(World()), keep=keep, previous=pose_of(camera_at(4), 4, "lost"))
    assert pose.status == "lost" and np.allclose(pose.T_world_camera, camera_at(5) @ exp_se3(OFF))


def shown_elsewhere(previous_status, continued):
    """The pose of a camera that sees the same walls and lines with other points than those of the map, after a frame of which it continues some."""
    world, other = World(2000), World(2000, 1)
    map, features, guess = first_map(world), list(world.features(camera_at(5), 5)), camera_at(5) @ exp_se3(OFF)
    features[0] = other.features(camera_at(5), 5)[0]
    rotation, translation = rotation_of(guess, 5, 0.5), translation_of(guess, 5, sigma_m=0.03)
    translation = dataclasses.replace(translation, inliers=np.array([continued, 20, 3], np.int32))
    matches = LocalMap()(world.frame(5).camera, rotation, translation, *features, map, None)
    return Refine()(world.frame(5).camera, rotation, translation, None, matches, *features, pose_of(camera_at(4), 4, previous_status), map, None)


def test_a_place_whose_points_are_unknown_is_another_one():
    """Its walls and lines agree with the map, as those of rooms built alike do."""
    pose = shown_elsewhere("ok", 3)
    assert pose.status == "lost" and pose.reason.startswith("another place: of ") and "3 key points continue the previous frame" in pose.reason
    assert shown_elsewhere("ok", 400).status != "lost"
    assert shown_elsewhere("lost", 400).status == "lost"  # continuing a lost frame says nothing about the place


def test_a_few_key_points_in_common_by_chance_are_no_place():
    """Two rooms have some four percent of their key points in common."""
    world = World(2000)
    with_depth = int(np.isfinite(world.features(camera_at(5), 5)[0].points_m[:, 2]).sum())
    assert shown_elsewhere("ok", int(0.05 * with_depth)).status == "lost" and shown_elsewhere("ok", int(0.08 * with_depth)).status != "lost"


def test_a_frame_that_most_of_the_map_contradicts_is_lost():
    """Nine in ten of the matched landmarks are others than those seen: what agrees does so by chance, and must not become part of the map."""
    world, map = World(4000), first_map(World(4000))
    features = world.features(camera_at(5), 5)
    rotation, translation = rotation_of(camera_at(5), 5, 0.5), translation_of(camera_at(5), 5, sigma_m=0.03)
    matches = LocalMap()(world.frame(5).camera, rotation, translation, *features, map, None)
    ids = matches.keypoints[:, 1].copy()
    ids[len(ids) // 10 :] = np.roll(ids[len(ids) // 10 :], 50)
    wrong = dataclasses.replace(
        matches, keypoints=np.stack([matches.keypoints[:, 0], ids], axis=1), segments=matches.segments[:0], planes=matches.planes[:0],
        parallel=matches.parallel[:0], perpendicular=matches.perpendicular[:0],
    )  # fmt: skip
    pose = Refine()(world.frame(5).camera, rotation, translation, None, wrong, *features, pose_of(camera_at(4), 4), map, None)
    assert pose.reason.startswith("the frame contradicts the map: only ") and pose.status == "lost"


def test_a_sub_map_that_does_not_show_the_frame_is_left():
    """Tied to nothing: a frame that is recognised elsewhere must not merge it there."""
    world, map = World(), first_map(World())
    of_submap = dataclasses.replace(map, keyframes=map.keyframes.updated(np.zeros(1, np.int32), submap=np.ones(1, np.int32)))
    features = world.features(camera_at(5), 5)
    far = camera_at(5) @ exp_se3(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    rotation, translation = rotation_of(camera_at(5), 5, 0.5), translation_of(camera_at(5), 5, sigma_m=0.03)
    matches = LocalMap()(world.frame(5).camera, rotation, translation, *features, of_submap, None)
    shuffled = dataclasses.replace(matches, keypoints=np.stack([matches.keypoints[:, 0], np.roll(matches.keypoints[:, 1], 7)], axis=1))
    previous = dataclasses.replace(pose_of(camera_at(4), 4), submap=1, reference=0)
    pose = Refine()(world.frame(5).camera, rotation, translation_of(far, 5, sigma_m=0.03), None, shuffled, *features, previous, of_submap, None)
    assert pose.status == "lost" and pose.submap == 1
    assert pose.reason.startswith("sub-map 1 does not show what the frame does: only ")


def repeating(steps):
    """Poses of frames 33 ms apart that show one image; with True as new, with False as one that repeats the one before."""
    world, map = World(), first_map(World())
    features = world.features(camera_at(5), 5)
    keypoints, _, planes = features
    rotation, translation = rotation_of(camera_at(5), 5, 0.5), translation_of(camera_at(5), 5, sigma_m=0.03)
    matches, (tracks, _, _) = LocalMap()(world.frame(5).camera, rotation, translation, *features, map, None), tracks_of(world, 4, 5)
    rows = {
        name: np.repeat(np.arange(count, dtype=np.int32)[:, None], 2, axis=1)
        for name, count in (("keypoints", 40), ("planes", len(planes.coefficients)))
    }
    same = dataclasses.replace(
        tracks,
        **rows,
        points_m=keypoints.points_m[:40],
        sigma_m=tracks.sigma_m[:40],
        coefficients=planes.coefficients,
        plane_covariance=np.zeros((len(planes.coefficients), 3, 3)),
    )
    pose, poses = pose_of(camera_at(4), 4), []
    for number, new in enumerate(steps):
        timed = dataclasses.replace(rotation, stamp_ns=pose.stamp_ns + 33_000_000, index=5 + number)
        pose = Refine()(world.frame(5).camera, timed, translation, tracks if new else same, matches, *features, pose, map, None)
        poses.append(pose)
    return poses


def test_images_that_repeat_twice_are_degraded():
    """The first repetition is one of a Kinect, the second is not; whatever differs ends it."""
    statuses = [(pose.repeats, pose.status) for pose in repeating([False, False, False, True, False])]
    assert statuses == [(1, "ok"), (2, "degraded"), (3, "degraded"), (0, "ok"), (1, "ok")]


@pytest.mark.parametrize("points, walls, repeated", [(30, 1, 3), (20, 1, 0), (30, 0, 0), (40, 0, 0), (0, 1, 0), (30, 3, 3)])
def test_an_image_may_repeat_in_part(points, walls, repeated):
    """So many of 40 key points with depth are bit-identical, and of the planes; half of the points may rest, as a robot's own arm does, and before a
    sensor that rounds its depths more of them, but no plane."""
    world, previous = World(), dataclasses.replace(pose_of(camera_at(4), 4), repeats=2)
    keypoints, _, planes = world.features(camera_at(5), 5)
    now, same = np.flatnonzero(np.isfinite(keypoints.points_m[:, 2]))[:40].astype(np.int32), np.arange(3, dtype=np.int32)
    before, coefficients = keypoints.points_m[now], planes.coefficients[:3].copy()
    before[points:, 0] += 1e-4
    coefficients[walls:, 3] += 1e-4
    tracks = dataclasses.replace(
        tracks_of(world, 4, 5)[0],
        keypoints=np.stack([now, now], axis=1),
        points_m=before,
        sigma_m=np.full(40, 0.01, np.float32),
        planes=np.stack([same, same], axis=1),
        coefficients=coefficients,
        plane_covariance=np.zeros((3, 3, 3)),
    )
    assert repeated_images(previous, tracks, keypoints, planes, InlierStatistics((40, 0, 3), (40, 0, 3))) == repeated


@pytest.mark.parametrize("share, moved_m, same, repeats", [(0.9, 0.1, 0, 1), (0.9, 0.0, 0, 0), (0.5, 0.1, 0, 0), (0.9, 0.1, 1, 0)])
def test_color_that_repeats_while_depth_does_not(share, moved_m, same, repeats):
    """Where most key points are bit-identical, planes that moved show that colour is frozen. Of a camera at rest they agree, and video repeats; and
    where a plane is bit-identical, depth repeats too."""
    world, map = World(), first_map(World())
    features = keypoints, segments, planes = world.features(camera_at(5), 5)
    camera, rotation, translation = world.frame(5).camera, rotation_of(camera_at(5), 5, 0.5), translation_of(camera_at(5), 5, sigma_m=0.03)
    matches = LocalMap()(camera, rotation, translation, *features, map, None)
    moved = dataclasses.replace(planes, coefficients=planes.coefficients + np.array([0.0, 0.0, 0.0, moved_m]))
    tracks = dataclasses.replace(
        tracks_of(world, 4, 5)[0],
        repeated=share,
        planes=np.zeros((same, 2), np.int32),
        coefficients=moved.coefficients[:same],
        plane_covariance=planes.covariance[:same],
    )
    pose = Refine()(camera, rotation, translation, tracks, matches, keypoints, segments, moved, pose_of(camera_at(4), 4), map, None)
    assert (pose.repeats, pose.status) == (repeats, "degraded" if repeats else "ok")
    if repeats:
        n = len(planes.coefficients)
        assert pose.reason == (
            f"colour repeats the previous frame, and depth does not: 90 % of the key points are bit-identical, {n} of {n} planes disagree"
        )


def test_a_repeated_image_is_no_measurement():
    """Of the camera's motion since it was taken nothing is known but that it went on about as it did; of its calibration nothing new."""
    first, *repeated = repeating([True, False, False, False])
    speed, rate = (np.linalg.norm(part) for part in np.split(first.twist, 2))
    assert speed > 0.1
    for count, pose in enumerate(repeated, 1):
        assert np.array_equal(pose.twist, first.twist)
        assert np.array_equal(pose.calibration_information, first.calibration_information)
        seconds, grown = 0.033 * count, pose.covariance - first.covariance
        sigmas = np.sqrt([np.trace(grown[:3, :3]), np.trace(grown[3:, 3:])])
        assert sigmas == pytest.approx([seconds * np.hypot(speed, 0.2), seconds * np.hypot(rate, 0.2)], rel=0.02)


def test_the_same_input_gives_the_same_bytes():
    world = World()
    poses = [refined(world, first_map(world)) for _ in range(2)]
    assert poses[0].T_world_camera.tobytes() == poses[1].T_world_camera.tobytes()
    assert poses[0].covariance.tobytes() == poses[1].covariance.tobytes()


@pytest.mark.parametrize("field", ["position_sigma_m", "rotation_sigma_deg", "line_sigma_px", "relation_sigma_deg"])
def test_ranges_are_checked(field):
    with pytest.raises(ValueError, match=field):
        Refine(**{field: 0.0})
