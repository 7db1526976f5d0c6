"""The measure of each slot on features that are known: 0 where they are right, and the error that was put in."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.comparison.partings import StageErrors
from trihedron.comparison.stage_measures import MEASURES, Seen, stage_errors
from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.types import LineSegments, Normals
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.matches.local_map import LocalMap

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins"))
from landmark_world import World, camera_at, pose_of, rotation_of, tracks_of, translation_of

BEFORE, NOW = 3, 4  # steps of the camera
EXACT = World(noise=0.0)
COLUMNS = ("pixels", "points_m", "sigma_px", "sigma_m", "octaves", "angles_deg", "descriptors")


def seen(step, **values):
    T = camera_at(step)
    keypoints, segments, planes = EXACT.features(T, step)
    return Seen({"dataset": EXACT.seen(T, step), "keypoints": keypoints, "segments": segments, "planes": planes, **values}, T)


def errors(topic, before=None, **values):
    return stage_errors(topic, seen(NOW, **values), before or seen(BEFORE))


def with_share(values, share, seed=0):
    """Rows that a share of the rows is chosen from, in random order."""
    return np.random.default_rng(seed).permutation(len(values))[: round(share * len(values))]


def test_planes_that_are_off_and_askew():
    planes, _ = EXACT.plane_regions(camera_at(NOW), NOW)
    right = errors("planes")
    assert right["planes mm"] < 0.01 and right["planes deg"] < 0.01 and right["planes lost %"] == 0.0
    off = planes.coefficients + np.array([0.0, 0.0, 0.0, 0.01])
    assert errors("planes", planes=replace(planes, coefficients=off))["planes mm"] == pytest.approx(10.0, abs=0.1)
    askew = planes.coefficients @ np.block([[exp_so3(np.radians([2.0, 0.0, 0.0])).T, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
    angles = np.degrees(np.arccos(np.clip(np.sum(askew[:, :3] * planes.coefficients[:, :3], axis=1), -1.0, 1.0)))
    assert errors("planes", planes=replace(planes, coefficients=askew))["planes deg"] == pytest.approx(np.sqrt(np.mean(angles**2)), abs=0.02)
    unseen = np.where(planes.labels == 1, 0, planes.labels)
    assert errors("planes", planes=replace(planes, labels=unseen))["planes lost %"] == pytest.approx(100.0 / len(planes.coefficients))


def test_key_points_that_are_not_found_again():
    keypoints, _ = EXACT.keypoints(camera_at(NOW), NOW)
    assert errors("keypoints")["points lost %"] == 0.0
    rows = with_share(keypoints.pixels, 0.75)
    fewer = replace(keypoints, **{name: getattr(keypoints, name)[rows] for name in COLUMNS})
    assert errors("keypoints", keypoints=fewer)["points lost %"] == pytest.approx(25.0, abs=5.0)


def test_lines_that_are_not_found_again():
    world = World(noise=0.0, marks=600)
    (old, _), (new, rows) = (world.segments(camera_at(step), step) for step in (BEFORE, NOW))
    lines = [LineSegments(step, 0, some.endpoints_px, some.descriptors) for step, some in ((BEFORE, old), (NOW, new))]
    before = seen(BEFORE, lines=lines[0])
    assert errors("lines", before, lines=lines[1])["lines lost %"] == 0.0
    kept = with_share(rows, 0.5)
    half = replace(lines[1], endpoints_px=new.endpoints_px[kept], descriptors=new.descriptors[kept])
    assert errors("lines", before, lines=half)["lines lost %"] == pytest.approx(50.0, abs=10.0)


def test_segments_that_are_off():
    new, _ = EXACT.segments(camera_at(NOW), NOW)
    assert errors("segments")["segments mm"] < 0.1
    across = np.cross(new.endpoints_m[:, 1] - new.endpoints_m[:, 0], [0.3, 0.5, 0.8])
    across *= 0.02 / np.linalg.norm(across, axis=1, keepdims=True)
    assert errors("segments", segments=replace(new, endpoints_m=new.endpoints_m + across[:, None].astype(np.float32)))[
        "segments mm"
    ] == pytest.approx(20.0, abs=0.5)


def test_normals_that_are_askew():
    frames = [EXACT.seen(camera_at(step), step) for step in (BEFORE, NOW)]
    normals = []
    for step, frame in zip((BEFORE, NOW), frames):
        planes, _ = EXACT.plane_regions(camera_at(step), step)
        table = np.concatenate([np.full((1, 3), np.nan), planes.coefficients[:, :3]]).astype(np.float32)
        normals.append(Normals(step, frame.stamp_ns, table[planes.labels], 8))
    before = Seen({"dataset": frames[0], "normals": normals[0]}, camera_at(BEFORE))
    turned = replace(normals[1], normals=(normals[1].normals @ exp_so3(np.radians([0.0, 0.0, 2.0]))).astype(np.float32))
    found = [stage_errors("normals", Seen({"dataset": frames[1], "normals": one}, camera_at(NOW)), before) for one in (normals[1], turned)]
    right, askew = (one["normals deg"] for one in found)
    assert right < 0.05 and 0.5 < askew <= 2.01  # a turn about the optical axis moves normals that are across it by 2 degrees


def test_pairs_that_are_wrong_and_missed():
    tracks, old, new = tracks_of(EXACT, BEFORE, NOW)
    before = seen(BEFORE, keypoints=old)
    assert errors("tracks", before, tracks=tracks, keypoints=new) == {"wrong pairs %": 0.0, "missed pairs %": 0.0, "one-way pairs %": 0.0}
    deep = np.flatnonzero(np.isfinite(tracks.points_m).all(axis=1))
    pairs = tracks.keypoints.copy()
    wrong = deep[with_share(deep, 0.2)]
    pairs[wrong, 1] = np.roll(pairs[wrong, 1], 1)
    found = errors("tracks", before, tracks=replace(tracks, keypoints=pairs), keypoints=new)
    assert found["wrong pairs %"] == pytest.approx(100.0 * len(wrong) / len(deep)) and found["missed pairs %"] == 0.0
    assert found["one-way pairs %"] == pytest.approx(100.0 * len(wrong) / len(pairs), abs=3.0)  # of some 200 pairs
    kept = np.setdiff1d(np.arange(len(pairs)), wrong)
    fewer = replace(tracks, keypoints=tracks.keypoints[kept], points_m=tracks.points_m[kept], sigma_m=tracks.sigma_m[kept])
    assert errors("tracks", before, tracks=fewer, keypoints=new)["missed pairs %"] == pytest.approx(20.0, abs=3.0)


def test_matches_that_are_wrong_and_missed():
    T0, T = camera_at(0), camera_at(NOW)
    map = Covisibility()(EXACT.frame(0), pose_of(T0, 0), *EXACT.features(T0, 0), None, None, None, None, None)
    features = EXACT.features(T, NOW)
    found = LocalMap()(EXACT.frame(NOW).camera, rotation_of(T, NOW), translation_of(T, NOW), *features, map, None)
    before = seen(BEFORE, map=map)
    assert errors("matches", before, matches=found) == {"wrong matches %": 0.0, "missed matches %": 0.0}
    pairs = found.keypoints.copy()
    wrong = with_share(pairs, 0.3)
    pairs[wrong, 1] = np.roll(pairs[wrong, 1], 1)
    assert errors("matches", before, matches=replace(found, keypoints=pairs))["wrong matches %"] == pytest.approx(30.0, abs=1.0)
    fewer = replace(found, keypoints=found.keypoints[np.setdiff1d(np.arange(len(pairs)), wrong)])
    assert errors("matches", before, matches=fewer)["missed matches %"] == pytest.approx(30.0, abs=3.0)


def moved(step, off=None):
    """The values of a frame whose estimates are off by a motion in the camera."""
    tracks, _, keypoints = tracks_of(EXACT, BEFORE, step)
    return seen(step, tracks=tracks, keypoints=keypoints, **estimates(camera_at(step) @ (np.eye(4) if off is None else off)))


def estimates(T):
    """Rotation, translation and pose of a camera."""
    return {"rotation": rotation_of(T, NOW), "translation": translation_of(T, NOW), "pose": pose_of(T, NOW)}


@pytest.mark.parametrize("topic", ["rotation", "translation", "pose"])
def test_a_right_motion_closes_the_cycle_and_warps_the_depth(topic):
    found = stage_errors(topic, moved(NOW), moved(BEFORE))
    assert found[f"{topic} cycle px"] < 0.01 and found[f"{topic} depth mm"] < 0.5


@pytest.mark.parametrize("topic", ["translation", "pose"])
def test_a_motion_towards_a_wall_that_is_20_mm_off_is_20_mm_off_in_depth(topic):
    wall, T, off = {"dataset": EXACT.frame(0)}, np.eye(4), pose_matrix(np.eye(3), np.array([0.0, 0.0, 0.02]))
    before, now = (Seen({**moved(BEFORE).values, **wall, **estimates(one)}, T) for one in (T, off))
    assert stage_errors(topic, now, before)[f"{topic} depth mm"] == pytest.approx(20.0, abs=0.01)
    assert stage_errors("rotation", now, before)["rotation depth mm"] == pytest.approx(0.0, abs=0.01)  # with the known translation


def test_a_rotation_about_the_optical_axis_moves_points_by_their_radius():
    off = moved(NOW, pose_matrix(exp_so3(np.radians([0.0, 0.0, 1.0])), np.zeros(3)))
    tracks, keypoints = off.values["tracks"], off.values["keypoints"]
    deep = tracks.keypoints[np.isfinite(tracks.points_m).all(axis=1), 1]
    radii = np.linalg.norm(keypoints.pixels[deep] - [319.5, 239.5], axis=1)
    for topic in ("rotation", "translation", "pose"):
        assert stage_errors(topic, off, moved(BEFORE))[f"{topic} cycle px"] == pytest.approx(
            2.0 * np.sin(np.radians(0.5)) * np.median(radii), rel=0.02
        )


def test_frames_follow_each_other_and_the_first_has_no_error():
    poses = {EXACT.frame(step).stamp_ns: camera_at(step) for step in range(4)}
    found = StageErrors(poses)
    for step in range(4):
        planes, _ = EXACT.plane_regions(camera_at(step), step)
        off = replace(planes, coefficients=planes.coefficients + np.array([0.0, 0.0, 0.0, 0.01 * (step == 2)]))
        found.take("planes", {"dataset": EXACT.seen(camera_at(step), step), "planes": off})
    assert found.of_frames()["planes mm"] == pytest.approx([np.nan, 0.0, 10.0, 0.0], abs=0.1, nan_ok=True)
    assert found.figures(found.of_frames())["planes mm"] == pytest.approx(10.0 / np.sqrt(3.0), abs=0.1)


def test_a_measure_without_what_it_needs_says_nothing():
    for topic in ("planes", "keypoints", "segments"):
        value = seen(NOW).values[topic]
        assert type(value) in MEASURES
        assert stage_errors(topic, Seen({topic: value}, camera_at(NOW)), Seen({}, camera_at(BEFORE))) == {}
        assert stage_errors(topic, seen(NOW), None) == {}
