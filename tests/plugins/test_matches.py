"""Landmarks of the local map found among the features of a frame, in a room that is known."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import Keypoints, Pose
from trihedron.plugins.map.covisibility import Covisibility
from trihedron.plugins.mapping.covisibility_graph import local_window, observed_by
from trihedron.plugins.mapping.landmark_kinds import POINT
from trihedron.plugins.mapping.projection import clip_segments
from trihedron.plugins.matches.local_map import LocalMap

sys.path.insert(0, str(Path(__file__).parent))
from landmark_world import CAMERA, World, camera_at, rotation_of, translation_of


def pose_of(T, index):
    return Pose(index, index * 33_000_000, T, np.eye(6) * 1e-8, T, -1, np.zeros(3, np.int32), 0, "ok", "")


def first_map(world):
    return Covisibility()(world.frame(0), pose_of(np.eye(4), 0), *world.features(np.eye(4), 0), None, None, None, None, None)


def matched(world, map, step, off=(0.0,) * 6, stage=None, features=None):
    """Matches of the frame at `step`, sought at its pose moved by `off`."""
    T = camera_at(step)
    guess = T @ exp_se3(np.asarray(off, float))
    rotation, translation = rotation_of(guess, step), translation_of(guess, step)
    return (stage or LocalMap())(world.frame(step).camera, rotation, translation, *(features or world.features(T, step)), map, None)


def right(pairs, feature_rows, landmark_rows):
    """How many pairs join a feature with the landmark of the same world row."""
    return sum(feature_rows[i] == landmark_rows[j] for i, j in pairs)


def test_there_are_no_matches_without_a_map():
    assert matched(World(), None, 1) is None


@pytest.mark.parametrize("off", [np.zeros(6), [0.01, -0.01, 0.02, 0.004, -0.003, 0.002]], ids=["exact", "2 cm and 0.3 degrees off"])
def test_points_lines_and_planes_are_found_and_are_the_right_ones(off):
    world = World()
    map = first_map(world)
    keypoints, rows = world.keypoints(camera_at(0), 0)
    born = rows[np.isfinite(keypoints.points_m).all(axis=1)]  # landmarks in the order of their key points
    found = matched(world, map, 6, off)
    _, now = world.keypoints(camera_at(6), 6)
    both = np.intersect1d(born, now)
    assert len(both) > 40 and right(found.keypoints, now, born) == len(found.keypoints) >= 0.9 * len(both)
    segments, lines = world.segments(camera_at(0), 0)
    lines = lines[np.isfinite(segments.endpoints_m).all(axis=(1, 2))]
    _, lines_now = world.segments(camera_at(6), 6)
    assert right(found.segments, lines_now, lines) == len(found.segments) >= 0.8 * len(np.intersect1d(lines, lines_now)) > 0
    _, planes = world.plane_regions(camera_at(0), 0)
    _, planes_now = world.plane_regions(camera_at(6), 6)
    assert right(found.planes, planes_now, planes) == len(found.planes) == len(np.intersect1d(planes, planes_now)) == 3
    assert set(found.keypoints[:, 1]) <= set(found.visible_points) and set(found.segments[:, 1]) <= set(found.visible_lines)


def test_walls_at_right_angles_and_opposite_walls_are_related():
    world = World(noise=0.0)
    found = matched(world, first_map(world), 2)
    assert len(found.planes) == 3 and len(found.parallel) == 0
    assert {tuple(pair) for pair in found.perpendicular} == {(a, b) for a in range(3) for b in range(3)} - {tuple(pair) for pair in found.planes}
    back = camera_at(0) @ exp_se3(np.array([0, 0, 0, 0, np.pi, 0]))
    features = world.features(back, 3)
    found = LocalMap()(world.frame(3).camera, rotation_of(back, 3), translation_of(back, 3), *features, first_map(world), None)
    assert len(found.planes) == 0 and len(found.parallel) >= 2


def test_the_other_side_of_a_thin_wall_is_another_plane():
    """2 cm thick: near enough for the distance gate, but the normal points the other way."""
    world = World(noise=0.0)
    map = first_map(world)
    keypoints, segments, planes = world.features(camera_at(0), 1)
    behind = planes.coefficients[:1] * -1.0 - [0, 0, 0, 0.02]
    faces = dataclasses.replace(planes, coefficients=np.concatenate([behind, planes.coefficients[1:]]))
    found = matched(world, map, 1, features=(keypoints, segments, faces))
    assert 0 not in found.planes[:, 0] and 0 in found.parallel[:, 0]


def test_two_regions_of_one_wall_are_both_found():
    world = World(noise=0.0)
    map = first_map(world)
    keypoints, segments, planes = world.features(camera_at(0), 1)
    twice = dataclasses.replace(
        planes,
        **{name: getattr(planes, name)[[0, 0, 1, 2]] for name in ("coefficients", "covariance", "moments", "pixels", "samples_m")},
    )
    found = matched(world, map, 1, features=(keypoints, segments, twice))
    assert list(found.planes[:, 0]) == [0, 1, 2, 3] and found.planes[0, 1] == found.planes[1, 1]


def test_a_wrong_descriptor_octave_or_direction_is_not_matched():
    world = World(noise=0.0)
    map = first_map(world)
    keypoints, segments, planes = world.features(camera_at(1), 1)
    other = dataclasses.replace(keypoints, descriptors=255 - keypoints.descriptors)
    assert len(matched(world, map, 1, features=(other, segments, planes)).keypoints) == 0
    coarse = dataclasses.replace(keypoints, octaves=keypoints.octaves + np.uint8(3))
    assert len(matched(world, map, 1, features=(coarse, segments, planes)).keypoints) == 0
    turned = dataclasses.replace(map, points=map.points.updated(np.arange(len(map.points)), direction=-map.points.column("direction")))
    assert len(matched(world, turned, 1).visible_points) == 0


def test_a_wider_search_finds_what_a_bad_guess_misses():
    """4 degrees are 37 px; the second search, not the first, reaches that far."""
    world = World(noise=0.0)
    map = first_map(world)
    off = [0, 0, 0, 0, np.radians(4.0), 0]
    narrow = LocalMap(radius_px=4.0, max_radius_px=20.0, wide_radius_px=20.0)
    assert len(matched(world, map, 1, off, stage=narrow).keypoints) < 5
    assert len(matched(world, map, 1, off).keypoints) > 40


def test_three_standard_deviations_of_the_prediction_are_searched():
    """Guesses drawn from the covariance that is stated of them, without a second search: of the true matches of noisy key points 97 % are found."""
    rng, world, step = np.random.default_rng(0), World(), 6
    map, features, (_, now) = first_map(world), world.features(camera_at(step), step), world.keypoints(camera_at(step), step)
    keypoints, rows = world.keypoints(camera_at(0), 0)
    born = rows[np.isfinite(keypoints.points_m).all(axis=1)]
    stage, found, kept = LocalMap(max_radius_px=50.0, enough=0), 0, 0
    for _ in range(20):
        guess = camera_at(step) @ exp_se3(rng.normal(size=6) * np.repeat([0.02, np.radians(0.8)], 3))
        rotation, translation = rotation_of(guess, step, 0.8), translation_of(guess, step, sigma_m=0.02)
        pairs = stage(world.frame(step).camera, rotation, translation, *features, map, None).keypoints
        found, kept = found + len(np.intersect1d(born, now)), kept + right(pairs, now, born)
    assert kept > 0.97 * found


def test_without_features_nothing_is_found():
    world = World()
    map = first_map(world)
    bare = World(points=0)
    bare.lines = bare.lines[:0]
    keypoints, segments, planes = bare.features(camera_at(1), 1)
    nothing = dataclasses.replace(
        planes, **{name: getattr(planes, name)[:0] for name in ("coefficients", "covariance", "moments", "pixels", "samples_m")}
    )
    found = matched(world, map, 1, features=(keypoints, segments, nothing))
    assert all(len(getattr(found, name)) == 0 for name in ("keypoints", "segments", "planes", "parallel", "perpendicular"))
    assert len(found.visible_points) > 40
    empty = first_map(bare)
    assert isinstance(keypoints, Keypoints) and len(matched(world, empty, 1).keypoints) == 0


def test_the_window_is_bounded_and_reaches_what_was_seen_from_here():
    """60 keyframes on a walk away and back: the window holds the newest, those that share landmarks with them, and the first ones."""
    world = World(noise=0.0)
    steps = [*range(0, 180, 6), *range(174, -1, -6)]
    map, stage = None, Covisibility(min_frames=1, max_frames=1, min_shift=1e-3)
    for index, step in enumerate(steps):
        T = camera_at(step)
        features = world.features(T, index)
        matches = LocalMap()(world.frame(index).camera, rotation_of(T, index), translation_of(T, index), *features, map, None)
        map = stage(world.frame(index), pose_of(T, index), *features, matches, map, None, None, None) or map
    assert len(map.keyframes) == len(steps)
    window = local_window(map, camera_at(0), newest=2, covisible=6, near=3)
    assert len(window.keyframes) <= 11 and {58, 59} <= set(window.keyframes) and 0 in window.keyframes
    assert set(window.points) == set(observed_by(map, window.keyframes, POINT)) and len(window.planes) >= 3


def test_segments_are_cut_at_the_image_and_at_the_camera():
    inside = np.array([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]])
    through = np.array([[0.0, 0.2, 2.0], [0.0, 0.2, -2.0]])  # passes below the camera and behind it
    behind = np.array([[0.0, 0.2, -1.0], [0.0, 0.4, -2.0]])
    beside = np.array([[5.0, 0.0, 2.0], [6.0, 0.0, 2.0]])
    pixels, left = clip_segments(np.array([inside, through, behind, beside]), np.eye(4), CAMERA)
    assert list(left) == [True, True, False, False]
    assert np.allclose(pixels[0], CAMERA.project(inside))
    assert np.allclose(pixels[1, 0], CAMERA.project(through[0])) and np.allclose(pixels[1, 1], [CAMERA.cx, CAMERA.height - 0.5])


@pytest.mark.parametrize(
    "options, field",
    [({"newest": 0}, "newest"), ({"radius_px": 30.0}, "radius_px"), ({"octave_scale": 1.0}, "octave_scale"), ({"view_deg": 0.0}, "view_deg")],
)
def test_ranges_are_checked(options, field):
    with pytest.raises(ValueError, match=field):
        LocalMap(**options)
