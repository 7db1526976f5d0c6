"""mixture: several Manhattan frames at once, each with an id that stays its own."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trihedron.pipeline.core.lie import exp_so3, rotation_angle_deg
from trihedron.plugins.manhattan.frame_association import associate_frames, camera_rotation, symmetric_angles
from trihedron.plugins.manhattan.mixture import Mixture
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE, nearest_equivalent

KINDS = [
    ("three planes, clean", 0.99, 0.4),
    ("three planes, noisy", 0.98, 0.5),
    ("two planes", 0.98, 0.5),
    ("one plane and lines", 0.99, 0.35),
    ("lines only", 0.99, 0.3),
    ("half clutter", 0.99, 0.3),
]


@pytest.mark.parametrize("kind,share,median_deg", KINDS)
def test_a_single_frame_any_way_round(directions, kind, share, median_deg):
    within, median, square = directions.figures(Mixture(), kind)
    assert within >= share and median < median_deg and 0.3 < square < 1.3


def test_no_claim_without_a_manhattan_frame(directions):
    claims = directions.claims(Mixture())
    assert len(claims) == 7 and max(claims.values()) == 0.0


def blocks(directions, rng, rotations, shares, lines=3, index=0):
    """(normals, segments, planes) of blocks of walls: frame i shows the share `shares[i]` of the image on its three axes together."""
    walls = np.concatenate([R.T for R in rotations])
    parts = np.repeat(np.array(shares) / 3.0, 3)
    return (
        directions.normals(rng, walls, parts, 2.5, index),
        directions.segments(rng, np.repeat(walls, lines, axis=0), index=index),
        directions.planes(rng, walls, parts, index=index),
    )


def apart(directions, rng, count=2):
    """Rotations whose axes are at least 14 degrees from each other's."""
    while True:
        rotations = [directions.rotation(rng) for _ in range(count)]
        cosines = [np.abs(a.T @ b).max() for i, a in enumerate(rotations) for b in rotations[:i]]
        if max(cosines) < np.cos(np.radians(14.0)):
            return rotations


def identities(estimator, directions):
    """Two frames with no axis in common. The second goes out of sight, comes back, becomes the heavier; at the end the camera jumps. Ids and the
    names of the axes stay."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        world, axis = apart(directions, rng), directions.spherical(rng, 1)[0]
        camera, ids, previous = np.eye(3), None, None
        for k in range(30):
            camera = exp_so3(np.radians(2.0 if k < 29 else 40.0) * axis) @ camera
            shown = [0] if 10 <= k < 18 else [0, 1]
            shares = [0.5] if len(shown) == 1 else ([0.5, 0.3] if k < 22 else [0.25, 0.5])
            previous = directions.estimate(estimator, blocks(directions, rng, [camera @ world[i] for i in shown], shares, index=k), previous)
            directions.check(previous)
            seen = previous.inliers.sum(axis=1) > 0
            assert previous.supported and list(seen[: len(shown)]) == [True] * len(shown) and not seen[len(shown) :].any()
            if k == 0:
                assert len(previous.ids) == 2
                ids = list(previous.ids)
                world = [camera.T @ nearest_equivalent(camera @ R, found) for R, found in zip(world, previous.rotations)]
            assert previous.ids[0] == ids[0 if k < 22 else 1]  # the best supported comes first
            for i in (0, 1):
                row = list(previous.ids).index(ids[i])
                assert rotation_angle_deg(previous.rotations[row].T @ camera @ world[i]) < 1.5
                sigma = np.degrees(np.sqrt(np.trace(previous.covariance[row])))
                assert sigma < 1.5 if i in shown else sigma > 30.0


def test_its_characteristic(directions):
    identities(Mixture(), directions)


def test_a_camera_that_turns_away_and_back_knows_both_again(directions):
    """From one frame over both to the other alone for 20 images, and back: each has its id, its place and its axes' names, in sight or not."""
    for seed in range(3):
        rng = np.random.default_rng(100 + seed)
        world, axis = apart(directions, rng), directions.spherical(rng, 1)[0]
        previous, names = None, {}
        for k in range(40):
            camera = exp_so3(np.radians(2.0 * min(k, 40 - k)) * axis)
            shown = [0] if k < 5 or k >= 35 else ([1] if 10 <= k < 30 else [0, 1])
            previous = directions.estimate(
                Mixture(), blocks(directions, rng, [camera @ world[i] for i in shown], [0.8 / len(shown)] * len(shown), index=k), previous
            )
            assert previous.supported and sorted(previous.ids.tolist()) == ([0] if k < 5 else [0, 1])
            for i in previous.ids.tolist():
                R = previous.rotations[previous.ids.tolist().index(i)]
                truth = names.setdefault(i, camera.T @ nearest_equivalent(camera @ world[i], R))
                assert rotation_angle_deg(R.T @ camera @ truth) < 1.5
                assert previous.inliers[previous.ids.tolist().index(i)].any() == (i in shown)


def test_frames_that_share_the_floor(directions):
    """A block of walls turned by 30 degrees on one floor: two frames, with the floor's normal as an axis of both."""
    rng = np.random.default_rng(11)
    for _ in range(20):
        R = directions.rotation(rng)
        other = exp_so3(np.radians(30.0) * R[:, 2]) @ R
        walls, shares = [R[:, 2], R[:, 0], other[:, 0], other[:, 1]], (0.25, 0.25, 0.2, 0.15)
        value = (directions.normals(rng, walls, shares), directions.segments(rng), directions.planes(rng, walls, shares))
        found = directions.estimate(Mixture(), value)
        assert found.supported and len(found.ids) == 2
        both = sorted(min(directions.error_deg(found, truth, row) for row in (0, 1)) for truth in (R, other))
        assert both[1] < 1.2


def test_a_piece_of_furniture_is_no_frame_of_its_own(directions):
    """A second frame needs an axis of its own with enough on it, and one at right angles."""
    rng = np.random.default_rng(12)
    for _ in range(20):
        R = directions.rotation(rng)
        stray = directions.spherical(rng, 1)
        while np.min(np.abs(stray @ R)) < 0.2:  # at right angles to nothing
            stray = directions.spherical(rng, 1)
        walls, shares = [*R.T, stray[0]], (0.25, 0.2, 0.2, 0.2)
        value = (
            directions.normals(rng, walls, shares),
            directions.segments(rng, directions.spherical(rng, 10)),
            directions.planes(rng, walls, shares),
        )
        found = directions.estimate(Mixture(), value)
        assert found.supported and len(found.ids) == 1 and directions.error_deg(found, R) < 1.0


def test_ids_are_never_given_twice(directions):
    rng = np.random.default_rng(13)
    pair, previous, met = apart(directions, rng), None, []
    for k in range(8):  # every block is left behind for the next, with a glimpse of both between
        pair = [pair[1], apart_from(directions, rng, pair[1])] if k else pair
        for shown in ([pair[0]], pair, [pair[1]]):
            value = blocks(directions, rng, shown, [0.8 / len(shown)] * len(shown), index=len(met))
            previous = directions.estimate(Mixture(max_frames=3), value, previous)
            assert len(previous.ids) <= 3
            for R in shown:
                row = int(np.argmin(symmetric_angles(previous.rotations, R[None])[:, 0]))
                met.append((int(previous.ids[row]), R.tobytes()))
    numbers, frames = {n for n, _ in met}, {R for _, R in met}
    assert len(numbers) == len(frames) == 9 and len(set(met)) == 9  # one to one


def apart_from(directions, rng, R):
    while True:
        other = directions.rotation(rng)
        if np.abs(other.T @ R).max() < np.cos(np.radians(14.0)):
            return other


def test_the_turn_that_brings_frames_onto_each_other(directions):
    rng = np.random.default_rng(14)
    for _ in range(10):
        before = np.array(apart(directions, rng, 3))
        Q = exp_so3(np.radians(50.0) * directions.spherical(rng, 1)[0])
        now = np.array([Q @ before[k] @ CUBE[rng.integers(24)] for k in (2, 0)])
        assert np.allclose(camera_rotation(now, before, np.radians(5.0)), Q)
        assert list(associate_frames(now, Q @ before, np.radians(5.0))) == [2, 0]
    assert np.allclose(camera_rotation(now[:0], before, 0.1), np.eye(3)) and len(associate_frames(now[:0], before, 0.1)) == 0


def test_one_wall_turns_all_that_is_known(directions):
    rng = np.random.default_rng(15)
    world = np.array(apart(directions, rng))
    turn = exp_so3(np.radians(3.0) * world[0][:, 1])
    value = directions.room(rng, turn @ world[0], (0,), (0.95,), (0, 0, 0))
    found = directions.estimate(Mixture(), value, directions.frame(world, ids=(4, 2)))
    assert not found.supported and list(found.ids) == [4, 2] and list(found.inliers[0] > 0) == [True, False, False]
    assert all(rotation_angle_deg(R.T @ turn @ truth) < 1.0 for R, truth in zip(found.rotations, world))
    sigma = np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[0])))
    assert sigma[1] < 1.0 and sigma[2] > 20.0


def test_naming_kept_through_a_turn_of_120_degrees(directions):
    errors = directions.turned(Mixture(), lambda rng, R, k: directions.room(rng, R, *([] if k % 4 else [(0, 2), (0.4, 0.4)]), index=k))
    assert max(errors) < 1.2


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.data())
def test_always_a_rotation(directions, data):
    *value, previous = directions.awkward(data)
    directions.check(directions.estimate(Mixture(), value, previous))


def test_same_bytes_again(directions):
    rng = np.random.default_rng(10)
    value = blocks(directions, rng, apart(directions, rng, 3), (0.3, 0.25, 0.2), lines=8)
    first = directions.estimate(Mixture(), value)
    assert len(first.ids) == 3
    found = directions.estimate(Mixture(), value, first)
    assert found.rotations.tobytes() == directions.estimate(Mixture(), value, first).rotations.tobytes()


@pytest.mark.parametrize(
    "wrong", [{"cone_deg": 0.0}, {"samples": 1}, {"min_own": 2.0}, {"merge_deg": 0.0}, {"max_frames": 0}, {"plane_floor_deg": 0.0}]
)
def test_fields_out_of_range(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Mixture(**wrong)
