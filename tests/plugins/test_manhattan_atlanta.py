"""atlanta: one vertical that all rotations share, horizontal directions at any angles, each with an id that stays its own."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trihedron.pipeline.core.lie import exp_so3, log_so3, rotation_angle_deg
from trihedron.plugins.manhattan.atlanta import Atlanta, match_azimuths, shared_covariance
from trihedron.plugins.manhattan.atlanta_kernels import fit_shared_vertical
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent

KINDS = [
    ("three planes, clean", 0.99, 0.4),
    ("three planes, noisy", 0.98, 0.5),
    ("two planes", 0.95, 0.5),
    ("one plane and lines", 0.99, 0.35),
    ("lines only", 0.99, 0.3),
    ("half clutter", 0.99, 0.35),
]


@pytest.mark.parametrize("kind,share,median_deg", KINDS)
def test_a_manhattan_world_is_an_atlanta_world(directions, kind, share, median_deg):
    within, median, square = directions.figures(Atlanta(), kind, 100)
    assert within >= share and median < median_deg and 0.3 < square < 1.5


def test_no_claim_without_right_angles(directions):
    claims = directions.claims(Atlanta())
    assert len(claims) == 7 and max(claims.values()) == 0.0


def world(angles_deg):
    """World rotations with the z axis in common."""
    return np.array([exp_so3(np.radians([0.0, 0.0, a])) for a in angles_deg])


def walls(directions, rng, camera, azimuths_deg, shares, floor=0.2, lines=3, index=0, noise_deg=2.5):
    """(normals, segments, planes) of a floor and upright walls with their normals at the azimuths, seen from R_camera_world, with upright edges."""
    surfaces = camera @ np.array([[0.0, 0.0, 1.0], *([np.cos(a), np.sin(a), 0.0] for a in np.radians(azimuths_deg))]).T
    all_shares = (floor, *shares) if floor else tuple(shares)
    surfaces = surfaces.T if floor else surfaces.T[1:]
    upright = np.repeat(camera[:, 2:].T, lines, axis=0)
    return (
        directions.normals(rng, surfaces, all_shares, noise_deg, index),
        directions.segments(rng, upright, index=index),
        directions.planes(rng, surfaces, all_shares, index=index),
    )


def one_vertical(estimator, directions):
    """Walls at 0, 30, 90 and 120 degrees: two rotations that share their third axis to the last digit, 30 degrees apart about it."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        camera = directions.rotation(rng)
        found = directions.estimate(estimator, walls(directions, rng, camera, [0, 30, 90, 120], [0.15] * 4))
        directions.check(found)
        assert found.supported and len(found.ids) == 2 and np.array_equal(found.rotations[0][:, 2], found.rotations[1][:, 2])
        assert abs(found.rotations[0][:, 2] @ camera[:, 2]) > np.cos(np.radians(0.6))
        for truth in camera @ world([0, 30]):
            assert min(directions.error_deg(found, truth, row) for row in (0, 1)) < 1.0
        assert (found.inliers > 0).all() and np.isfinite(found.spread).all()


def test_its_characteristic(directions):
    one_vertical(Atlanta(), directions)


def test_no_two_walls_at_right_angles(directions):
    """Walls at 0, 37 and 66 degrees and a floor: three azimuths, each rotation known in all three angles."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        camera = directions.rotation(rng)
        found = directions.estimate(Atlanta(), walls(directions, rng, camera, [0, 37, 66], [0.2] * 3))
        assert found.supported and len(found.ids) == 3
        for truth in camera @ world([0, 37, 66]):
            row = min(range(3), key=lambda k: directions.error_deg(found, truth, k))
            assert directions.error_deg(found, truth, row) < 1.2
            assert np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[row])[-1])) < 1.5
            assert sorted((found.inliers[row] > 0).tolist()) == [False, True, True]


def test_every_wall_holds_the_vertical(directions):
    """Without a floor or an upright edge two walls at 90 degrees tell the vertical, and a third at 45 helps."""
    rng, tilts = np.random.default_rng(5), {}
    for azimuths in ([0, 90], [0, 90, 45, 135]):
        tilts[len(azimuths)] = []
        for _ in range(40):
            camera = directions.rotation(rng)
            value = walls(directions, rng, camera, azimuths, [0.7 / len(azimuths)] * len(azimuths), floor=0.0, lines=0)
            found = directions.estimate(Atlanta(), value, directions.frame(camera))
            assert found.supported
            tilts[len(azimuths)].append(np.degrees(np.linalg.norm(np.cross(found.rotations[0][:, 2], camera[:, 2]))))
    assert np.median(tilts[2]) < 0.5 and np.median(tilts[4]) < 0.85 * np.median(tilts[2])


def test_the_vertical_is_corrected_when_more_is_seen(directions):
    """A floor and one wall look alike; other azimuths tell them apart."""
    rng = np.random.default_rng(6)
    camera = directions.rotation(rng)
    wrong = camera[:, [1, 2, 0]]  # the wall for the vertical
    found = directions.estimate(Atlanta(), walls(directions, rng, camera, [0, 30, 90, 120], [0.15] * 4), directions.frame(wrong, ids=(5,)))
    assert found.supported and len(found.ids) == 2 and 5 in found.ids
    assert abs(found.rotations[0][:, 2] @ camera[:, 2]) > np.cos(np.radians(0.6))


def test_ids_survive_a_look_away(directions):
    """A camera turns about the vertical from one block to another and back: out of sight a block is carried on, and comes back with its id."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        start, previous, ids = directions.rotation(rng), None, []
        for k in range(40):
            camera = start @ world([2.0 * k if k < 20 else 2.0 * (40 - k)])[0].T
            shown = [0, 90, 35] if k < 8 or k >= 32 else ([35, 125] if 12 <= k < 28 else [0, 35])
            value = walls(directions, rng, camera, shown, [0.6 / len(shown)] * len(shown), index=k)
            previous = directions.estimate(Atlanta(), value, previous)
            directions.check(previous)
            assert previous.supported and len(previous.ids) == 2
            if k == 0:
                ids = list(previous.ids)
                blocks = [start.T @ R for R in previous.rotations]
            seen = dict(zip(previous.ids.tolist(), previous.inliers.any(axis=1)))
            assert list(seen.values()).count(True) == (1 if 12 <= k < 28 else 2)
            for i, block in zip(ids, blocks):
                row = list(previous.ids).index(i)
                assert rotation_angle_deg(previous.rotations[row].T @ camera @ block) < 1.5
                sigma = np.degrees(np.sqrt(np.trace(previous.covariance[row])))
                assert sigma < 2.0 if seen[i] else sigma > 30.0


def test_covariance_of_shared_fit(directions):
    """The error of both rotations, in units of the covariance said, with planes as uncertain as they say."""
    rng, squares = np.random.default_rng(7), []
    for _ in range(100):
        camera = directions.rotation(rng)
        found = directions.estimate(Atlanta(), walls(directions, rng, camera, [0, 30, 90, 120], [0.15] * 4))
        for truth in camera @ world([0, 30]):
            row = min((0, 1), key=lambda k: directions.error_deg(found, truth, k))
            phi = log_so3(truth @ nearest_equivalent(found.rotations[row], truth).T)
            squares.append(phi @ np.linalg.solve(found.covariance[row], phi) / 3.0)
    assert 0.3 < np.mean(squares) < 1.5


def test_fit_is_exact_and_its_information_right(directions):
    rng = np.random.default_rng(8)
    truth = directions.rotation(rng) @ world([0, 25, 60])
    columns = np.array([2, 0, 1, 3, 7], np.int32)
    measured = np.array([truth[c // 3][:, c % 3] for c in columns])
    information = (np.eye(3) - measured[:, :, None] * measured[:, None, :]) / np.radians(0.5) ** 2
    start = exp_so3(np.radians([2.0, -1.0, 1.5])) @ truth
    found, H, chi2, components = fit_shared_vertical(-measured, information, columns, 5, start, 1e-6, 1e6, 8)
    assert np.allclose(found, truth, atol=1e-6) and chi2 < 1e-6 and components == pytest.approx(10.0)
    turns = np.degrees(np.sqrt([truth[0][:, 2] @ C @ truth[0][:, 2] for C in shared_covariance(H, found, 1e6)]))
    assert np.allclose(turns, [0.5 / np.sqrt(2.0), 0.5, 0.5], rtol=0.01)  # two walls, one wall, one wall


def test_azimuths_keep_their_angles_to_each_other(directions):
    rng = np.random.default_rng(9)
    known = directions.rotation(rng) @ world([0, 25, 60])
    now = exp_so3(np.radians(12.0) * known[0][:, 2]) @ known
    named, rows = match_azimuths(now[[2, 0]] @ np.diag([-1.0, 1.0, -1.0]), known, np.radians(4.0), np.radians(20.0))
    assert list(rows) == [2, 0] and np.allclose(named, now[[2, 0]])
    named, rows = match_azimuths(world([40]) @ np.eye(3), world([0, 5]), np.radians(4.0), np.radians(20.0))
    assert list(rows) == [1] and np.allclose(named[0], world([40])[0])


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.data())
def test_always_a_rotation(directions, data):
    *value, previous = directions.awkward(data)
    found = directions.estimate(Atlanta(), value, previous)
    directions.check(found)
    assert np.allclose(found.rotations[:, :, 2], found.rotations[0, :, 2], atol=1e-9)


def test_same_bytes_again(directions):
    rng = np.random.default_rng(10)
    value = walls(directions, rng, directions.rotation(rng), [0, 30, 90, 120], [0.15] * 4, lines=60)
    first = directions.estimate(Atlanta(), value)
    found = directions.estimate(Atlanta(), value, first)
    again = directions.estimate(Atlanta(), value, replace(first))
    assert all(getattr(found, name).tobytes() == getattr(again, name).tobytes() for name in ("rotations", "covariance", "ids"))


@pytest.mark.parametrize(
    "wrong", [{"cone_deg": 0.0}, {"samples": 1}, {"min_azimuth": 2.0}, {"again_deg": 0.0}, {"max_azimuths": 0}, {"apart_deg": 1}]
)
def test_fields_out_of_range(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        Atlanta(**wrong)
