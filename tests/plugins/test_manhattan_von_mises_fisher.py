"""von_mises_fisher: the concentration of the directions is estimated with the rotation, so the spread is theirs and the covariance follows."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trihedron.pipeline.core.lie import exp_so3, rotation_angle_deg
from trihedron.plugins.manhattan.von_mises_fisher import VonMisesFisher, broad_mixture
from trihedron.plugins.manhattan.von_mises_fisher_kernels import em_step

KINDS = [
    ("three planes, clean", 0.99, 0.1),
    ("three planes, noisy", 0.99, 0.4),
    ("two planes", 0.99, 0.3),
    ("one plane and lines", 0.99, 0.3),
    ("lines only", 0.99, 0.3),
    ("half clutter", 0.99, 0.35),
]


@pytest.mark.parametrize("kind,share,median_deg", KINDS)
def test_axes_any_way_round(directions, kind, share, median_deg):
    within, median, square = directions.figures(VonMisesFisher(), kind)
    assert within >= share and median < median_deg
    assert square < 1.0  # neighbouring normals err alike, which these do not: the covariance is the larger


def test_no_claim_without_a_manhattan_frame(directions):
    claims = directions.claims(VonMisesFisher())
    assert len(claims) == 7 and max(claims.values()) == 0.0


def spread_of_every_axis(estimator, directions):
    """Three walls with noise of 2, 5 and 9 degrees, and clutter: the spread reported is each one's own, nothing cut off."""
    rng, noise, found = np.random.default_rng(3), np.array([2.0, 5.0, 9.0]), []
    for _ in range(12):
        R = directions.rotation(rng)
        value = (directions.normals(rng, R.T, (0.3, 0.3, 0.25), noise), directions.segments(rng), directions.planes(rng))
        one = directions.estimate(estimator, value)
        assert one.supported and directions.error_deg(one, R) < 1.0
        found.append(np.degrees(one.spread[0][np.argmax(np.abs(one.rotations[0].T @ R), axis=0)]) / np.sqrt(2.0))
    assert np.all(np.abs(np.mean(found, axis=0) / noise - 1.0) < 0.08) and np.all(np.abs(np.array(found) / noise - 1.0) < 0.2)


def test_its_characteristic(directions):
    spread_of_every_axis(VonMisesFisher(), directions)


def test_each_step_makes_the_directions_more_likely(directions):
    rng = np.random.default_rng(4)
    R = directions.rotation(rng)
    vectors = directions.normals(rng, R.T, (0.3, 0.2, 0.1), 4.0).normals.reshape(-1, 3).astype(float)
    vectors = vectors[np.isfinite(vectors[:, 0])]
    weights = np.ones(len(vectors))

    def likelihood(m):
        dot = np.abs(vectors @ m.R)
        kappa, share = m.concentration[0], m.share[0]
        return np.log((share[:3] * kappa * np.exp(kappa * (dot - 1.0))).sum(axis=1) + share[3]).sum()

    mixture = broad_mixture(exp_so3(np.radians([8.0, -6.0, 5.0])) @ R, np.radians(10.0) ** -2)
    before, gains = likelihood(mixture), []
    for _ in range(20):
        mixture = em_step(mixture, vectors, weights, len(vectors), 1e-6, 200.0)
        after = likelihood(mixture)
        gains.append(after - before)
        before = after
    assert gains[0] > 100.0 and min(gains) > -0.5 and rotation_angle_deg(R.T @ mixture.R) < 0.3
    assert np.allclose(mixture.share[0], [0.3, 0.2, 0.1, 0.4], atol=0.02)


def test_covariance_follows_the_concentration(directions):
    rng = np.random.default_rng(5)
    R, sigma = directions.rotation(rng), []
    for noise in (2.0, 6.0, 9.0):
        found = VonMisesFisher(axis_floor_deg=0.01, floor_deg=0.01)(
            directions.normals(rng, R.T, (0.3, 0.3, 0.3), noise), directions.segments(rng), None
        )
        sigma.append(np.sqrt(np.trace(found.covariance[0])))
    assert np.allclose(np.array(sigma) / sigma[0], [1.0, 3.0, 4.5], rtol=0.15)


def test_found_from_ten_degrees_off_and_the_naming_kept(directions):
    rng = np.random.default_rng(6)
    for _ in range(100):
        R = directions.rotation(rng)
        off = exp_so3(np.radians(10.0) * directions.spherical(rng, 1)[0]) @ R
        found = directions.estimate(VonMisesFisher(), directions.room(rng, R), directions.frame(off))
        assert found.supported and rotation_angle_deg(found.rotations[0].T @ R) < 1.0
    errors = directions.turned(VonMisesFisher(), lambda rng, R, k: directions.room(rng, R, *([] if k % 4 else [(0, 2), (0.4, 0.4)])))
    assert max(errors) < 1.0


def test_found_again_after_a_jump(directions):
    rng = np.random.default_rng(7)
    R = directions.rotation(rng)
    turned = exp_so3(np.radians(35.0) * R[:, 1]) @ R
    found = directions.estimate(VonMisesFisher(), directions.room(rng, turned), directions.frame(R))
    assert found.supported and rotation_angle_deg(found.rotations[0].T @ turned) < 1.0


def test_lines_and_normals_have_concentrations_of_their_own(directions):
    """Rough walls do not blur the lines: with exact lines beside normals of 9 degrees the error is that of the lines."""
    rng = np.random.default_rng(8)
    both, alone = [], []
    for _ in range(30):
        R = directions.rotation(rng)
        value = directions.room(rng, R, noise_deg=9.0, lines=(10, 10, 10))
        both.append(directions.error_deg(directions.estimate(VonMisesFisher(), value), R))
        alone.append(directions.error_deg(directions.estimate(VonMisesFisher(), (value[0], directions.segments(rng), value[2])), R))
    assert np.median(both) < 0.7 * np.median(alone)


def test_one_wall_tells_two_of_three_angles(directions):
    rng = np.random.default_rng(9)
    R = directions.rotation(rng)
    value = directions.room(rng, R, (0,), (0.95,), (0, 0, 0))
    found = directions.estimate(VonMisesFisher(), value, directions.frame(exp_so3(np.radians(4.0) * R[:, 1]) @ R))
    assert not found.supported and np.isfinite(found.spread[0, 0]) and np.isnan(found.spread[0, 1])
    turn, tilt = (np.degrees(np.sqrt(a @ found.covariance[0] @ a)) for a in (R[:, 0], R[:, 1]))
    assert turn > 20.0 and tilt < 1.0 and abs(found.rotations[0][:, 0] @ R[:, 0]) > np.cos(np.radians(0.5))


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.data())
def test_always_a_rotation(directions, data):
    *value, previous = directions.awkward(data)
    directions.check(directions.estimate(VonMisesFisher(), value, previous))


def test_same_bytes_again(directions):
    rng = np.random.default_rng(10)
    value = directions.room(rng, directions.rotation(rng), lines=(30, 30, 30))
    first = directions.estimate(VonMisesFisher(), value)
    found = directions.estimate(VonMisesFisher(), value, first)
    assert found.rotations.tobytes() == directions.estimate(VonMisesFisher(), value, first).rotations.tobytes()


@pytest.mark.parametrize(
    "wrong", [{"samples": 1}, {"start_spread_deg": 0.0}, {"min_share": 2.0}, {"prior": 0.0}, {"max_iterations": 0}, {"axis_floor_deg": -1.0}]
)
def test_fields_out_of_range(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        VonMisesFisher(**wrong)
