"""plane_svd: the rotation of perpendicular planes, in closed form, whatever else is in the scene."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trihedron.pipeline.core.lie import exp_so3, rotation_angle_deg
from trihedron.plugins.manhattan.mean_shift import MeanShift
from trihedron.plugins.manhattan.plane_svd import PlaneSvd


@pytest.mark.parametrize(
    "kind,share,median_deg",
    [("three planes, clean", 0.99, 0.45), ("three planes, noisy", 0.99, 0.45), ("two planes", 0.93, 0.55), ("half clutter", 0.99, 0.45)],
)
def test_planes_any_way_round(directions, kind, share, median_deg):
    within, median, square = directions.figures(PlaneSvd(), kind, 300)
    assert within >= share and median < median_deg and 0.5 < square < 1.3


@pytest.mark.parametrize("kind", ["one plane and lines", "lines only"])
def test_less_than_two_planes_are_not_enough(directions, kind):
    assert directions.figures(PlaneSvd(), kind, 30)[0] == 0.0


def test_no_claim_where_no_planes_are_perpendicular(directions):
    claims = directions.claims(PlaneSvd())
    assert len(claims) == 7 and max(claims.values()) == 0.0


def planes_rule(estimator, directions):
    """Planes of one Manhattan frame among the many normals and lines of another: the planes are believed, and only they."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        R = directions.rotation(rng)
        other = R @ exp_so3(np.radians(25.0) * directions.spherical(rng, 1)[0])
        planes = directions.room(rng, R)[2]
        normals, segments, _ = directions.room(rng, other, lines=(10, 10, 10))
        found = directions.estimate(estimator, (normals, segments, planes))
        assert found.supported and len(found.rotations) == 1 and directions.error_deg(found, R) < 1.5
        assert list(found.inliers[0]) == [1, 1, 1]


def test_its_characteristic(directions):
    planes_rule(PlaneSvd(), directions)


def test_it_is_the_minimum_of_the_weighted_squares(directions):
    rng = np.random.default_rng(4)
    plain = PlaneSvd(gate=1e6)
    R = directions.rotation(rng)
    planes = directions.planes(rng, [*R.T, *R.T[:2]], [0.3, 0.2, 0.2, 0.1, 0.1], sigma_deg=1.0)
    variance = np.radians(rng.uniform(0.1, 1.0, 5)) ** 2
    covariance = variance[:, None, None] * np.eye(3)
    planes = replace(planes, covariance=covariance)
    found = plain(planes, None).rotations[0]
    weights = 1.0 / (variance + np.radians(plain.plane_floor_deg) ** 2)

    def cost(R):
        return (weights * (2.0 - 2.0 * np.abs(planes.coefficients[:, :3] @ R).max(axis=1))).sum()

    assert all(cost(found) < cost(exp_so3(rng.normal(0, np.radians(size), 3)) @ found) for size in (0.03, 0.3, 3.0) for _ in range(100))
    assert cost(found) < cost(MeanShift()(*directions.room(rng, R)[:2], planes, None).rotations[0])


def test_uncertain_planes_weigh_less(directions):
    rng = np.random.default_rng(5)
    R = directions.rotation(rng)
    planes = directions.planes(rng, R.T, (0.3, 0.3, 0.3), sigma_deg=0.0)
    off = exp_so3(np.radians(2.0) * R[:, 2]) @ R[:, 0]
    coefficients, covariance = planes.coefficients.copy(), planes.covariance.copy()
    coefficients[0, :3], covariance[0] = off, np.diag([np.radians(3.0) ** 2] * 2 + [1e-5])
    found = PlaneSvd()(replace(planes, coefficients=coefficients, covariance=covariance), None)
    alike = PlaneSvd(gate=1e6)(replace(planes, coefficients=coefficients), None)
    assert directions.error_deg(found, R) < 0.1 and 0.8 < directions.error_deg(alike, R) < 1.2


def test_naming_kept_through_a_turn_of_120_degrees(directions):
    errors = directions.turned(
        PlaneSvd(), lambda rng, R, k: directions.room(rng, R, *([(0, 1, 2), (0.3, 0.3, 0.3)] if k % 5 else [(0, 2), (0.4, 0.4)]))
    )
    assert max(errors) < 1.5


def test_of_two_frames_the_previous_is_kept_until_the_other_is_clearly_better(directions):
    rng = np.random.default_rng(6)
    R = directions.rotation(rng)
    other = exp_so3(np.radians(30.0) * R[:, 2]) @ R
    for share, kept in ((0.22, True), (0.30, False)):
        planes = directions.planes(rng, [R[:, 2], R[:, 0], other[:, 0]], (0.3, 0.2, share), sigma_deg=0.2)
        found = PlaneSvd()(planes, directions.frame(R))
        assert found.supported and (directions.error_deg(found, R) < 1.0) == kept and (directions.error_deg(found, other) < 1.0) != kept


def test_one_wall_tells_two_of_three_angles(directions):
    rng = np.random.default_rng(8)
    R = directions.rotation(rng)
    wall = exp_so3(np.radians(3.0) * R[:, 1]) @ R[:, 0]
    found = PlaneSvd()(directions.planes(rng, [wall], (0.5,), sigma_deg=0.0), directions.frame(R))
    assert not found.supported and list(found.inliers[0]) == [1, 0, 0] and np.isnan(found.spread[0, 1])
    assert abs(found.rotations[0][:, 0] @ wall) > np.cos(np.radians(0.1)) and rotation_angle_deg(found.rotations[0].T @ R) < 3.1
    turn, tilt = (np.degrees(np.sqrt(a @ found.covariance[0] @ a)) for a in (wall, R[:, 1]))
    assert turn > 20.0 and tilt < 1.0


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.data())
def test_always_a_rotation(directions, data):
    _, _, planes, previous = directions.awkward(data)
    directions.check(PlaneSvd()(planes, previous))


def test_same_bytes_again(directions):
    rng = np.random.default_rng(9)
    value = directions.room(rng, directions.rotation(rng), strays=20)
    first = PlaneSvd()(value[2], None)
    found = PlaneSvd()(value[2], first)
    assert found.rotations.tobytes() == PlaneSvd()(value[2], first).rotations.tobytes()


@pytest.mark.parametrize(
    "wrong", [{"max_cos": 0.5}, {"reach_deg": 0.0}, {"min_share": 0.0}, {"loyalty": 0.5}, {"gate": 0.0}, {"plane_floor_deg": -1.0}]
)
def test_fields_out_of_range(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        PlaneSvd(**wrong)
