"""branch_and_bound: right from anywhere, and it says how far from the best it can be at most."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trihedron.pipeline.core.lie import exp_so3, rotation_angle_deg
from trihedron.plugins.manhattan.branch_and_bound import BranchAndBound
from trihedron.plugins.manhattan.mean_shift import MeanShift

KINDS = [
    ("three planes, clean", 0.99, 0.4),
    ("three planes, noisy", 0.99, 0.45),
    ("two planes", 0.97, 0.5),  # the planes' own 0.36° per tangent coordinate
    ("one plane and lines", 0.99, 0.35),
    ("lines only", 0.99, 0.3),
    ("half clutter", 0.99, 0.3),
]


@pytest.mark.parametrize("kind,share,median_deg", KINDS)
def test_axes_any_way_round(directions, kind, share, median_deg):
    within, median, square = directions.figures(BranchAndBound(), kind, 80)
    assert within >= share and median < median_deg and 0.3 < square < 1.3


def two_axes(directions, rng, R):
    """Two of the walls seen, a quarter of the cells each with 3° of noise; the other half, ten segments and two small planes are any way."""
    axes = rng.permutation(3)[:2]
    walls = [*R.T[axes], *directions.spherical(rng, 2)]
    normals = directions.normals(rng, walls[:2], (0.25, 0.25))
    return normals, directions.segments(rng, directions.spherical(rng, 10)), directions.planes(rng, walls, (0.25, 0.25, 0.03, 0.03), sigma_deg=0.2)


def figures_from_anywhere(directions, count):
    """Errors (deg) where two axes are visible among 50 % clutter, after nothing or after any rotation taken for supported; and the gaps."""
    rng, estimator, errors, gaps = np.random.default_rng(11), BranchAndBound(), [], []
    for k in range(count):
        R = directions.rotation(rng)
        previous = directions.frame(directions.rotation(rng)) if k % 2 else None
        found = estimator(*two_axes(directions, rng, R), previous)
        errors.append(directions.error_deg(found, R) if found.supported else 90.0)
        gaps.append(found.gap)
    return np.array(errors), np.array(gaps)


def test_right_from_anywhere(directions):
    errors, gaps = figures_from_anywhere(directions, 150)
    assert errors.max() < 1.0 and np.median(errors) < 0.4 and gaps.min() >= 0.0 and gaps.max() < 0.01


@pytest.mark.slow
def test_right_from_anywhere_a_thousand_times(directions):
    errors, gaps = figures_from_anywhere(directions, 1000)
    assert np.mean(errors < 1.0) >= 0.999 and np.median(errors) < 0.4 and gaps.min() >= 0.0 and gaps.max() < 0.01


def test_no_claim_without_a_manhattan_frame(directions):
    claims = directions.claims(BranchAndBound(), 8)
    assert len(claims) == 7 and max(claims.values()) == 0.0


def certificate(estimator, directions):
    """Two Manhattan frames in one scene, told to start from the lesser: the better one is found, and a gap that no rotation refutes."""
    rng = np.random.default_rng(3)
    inlier = np.radians(BranchAndBound().inlier_deg)
    for _ in range(5):
        R = directions.rotation(rng)
        other = R @ exp_so3(np.radians(30.0) * np.full(3, 1.0 / np.sqrt(3.0)))
        surfaces = [*R.T, *other.T]
        value = directions.normals(rng, surfaces, (0.19,) * 3 + (0.13,) * 3), directions.segments(rng), directions.planes(rng)
        found = directions.estimate(estimator, value, directions.frame(other))
        assert found.supported and len(found.rotations) == 1 and directions.error_deg(found, R) < 1.0
        assert 0.0 <= found.gap < 0.01
        vectors = value[0].normals.reshape(-1, 3)[np.isfinite(value[0].normals[..., 0].ravel())].astype(float)

        def consensus(R, vectors=vectors):
            return np.maximum(1.0 - (1.0 - ((vectors @ R) ** 2).max(axis=1)) / np.sin(inlier) ** 2, 0.0).sum()

        reached = consensus(found.rotations[0])
        near = [exp_so3(np.radians(rng.uniform(0.0, 5.0)) * axis) @ S for axis in directions.spherical(rng, 40) for S in (R, other)]
        assert max(map(consensus, near + [directions.rotation(rng) for _ in range(100)])) <= reached * (1.0 + found.gap)


def test_its_characteristic(directions):
    certificate(BranchAndBound(), directions)


def test_gap_is_that_of_the_rotation_returned(directions):
    """Where planes overrule the optimum of the consensus, the gap tells what that costs."""
    rng = np.random.default_rng(4)
    R = directions.rotation(rng)
    normals, segments, _ = directions.room(rng, R, lines=(0, 0, 0))
    true = directions.planes(rng, R.T, (0.3, 0.3, 0.3), sigma_deg=0.0)
    turned = exp_so3(np.radians(3.0) * R[:, 0])
    off = replace(true, coefficients=np.concatenate([true.coefficients[:, :3] @ turned.T, true.coefficients[:, 3:]], axis=1))
    estimator = BranchAndBound(normals_floor_deg=3.0, plane_weight=0.0)
    near, far = estimator(normals, segments, true, None), estimator(normals, segments, off, None)
    assert directions.error_deg(far, turned @ R) < 0.5 < 2.5 < directions.error_deg(far, R) and near.gap < 0.005 and far.gap > near.gap + 0.02


def test_work_limit(directions):
    """Fewer cubes than needed: still a rotation and a gap, a wider one; and never another answer for another load of the machine."""
    rng = np.random.default_rng(5)
    value = directions.room(rng, directions.rotation(rng), shares=(0.2, 0.1, 0.1), noise_deg=5.0, strays=20)
    limited = [BranchAndBound(max_cubes=cubes)(*value, None) for cubes in (1, 2000, 10_000)]
    assert limited[0].gap > limited[1].gap > limited[2].gap and 0.02 < limited[0].gap < np.inf and limited[2].gap < 0.02
    again = BranchAndBound(max_cubes=2000)(*value, None)
    assert again.gap == limited[1].gap and again.rotations.tobytes() == limited[1].rotations.tobytes()


def test_as_accurate_as_mean_shift(directions):
    rng, estimator = np.random.default_rng(6), BranchAndBound()
    for _ in range(20):
        R = directions.rotation(rng)
        value = directions.room(rng, R, noise_deg=4.0, strays=10)
        best, local = estimator(*value, None), MeanShift()(*value, directions.frame(R))
        assert directions.error_deg(best, R) < 1.0
        assert directions.error_deg(best, local.rotations[0]) < 0.05 and np.allclose(best.covariance, local.covariance, rtol=0.2)
        assert np.isclose(best.inliers.sum(), local.inliers.sum(), rtol=0.05) and np.isnan(local.gap)


def test_naming_kept_through_a_turn_of_120_degrees(directions):
    errors = directions.turned(
        BranchAndBound(), lambda rng, R, k: directions.room(rng, R, *([(0, 1, 2), (0.3, 0.3, 0.3)] if k % 5 else [(0, 2), (0.4, 0.4)]))
    )
    assert max(errors) < 1.5


def test_one_wall_leaves_its_turn_to_the_previous_frame(directions):
    rng = np.random.default_rng(8)
    R = directions.rotation(rng)
    value = directions.normals(rng, R.T[:1], (0.97,)), directions.segments(rng), directions.planes(rng, R.T[:1], (0.97,), sigma_deg=0.1)
    found = BranchAndBound()(*value, directions.frame(R))
    assert not found.supported and np.isnan(found.gap) and rotation_angle_deg(found.rotations[0].T @ R) < 1.0
    turn, tilt = (np.degrees(np.sqrt(a @ found.covariance[0] @ a)) for a in (R[:, 0], R[:, 1]))
    assert turn > 20.0 and tilt < 1.0


@settings(max_examples=80, deadline=None, derandomize=True)
@given(st.data())
def test_always_a_rotation(directions, data):
    normals, segments, planes, previous = directions.awkward(data)
    found = BOUNDED(normals, segments, planes, previous)
    directions.check(found)
    assert np.isnan(found.gap) or found.gap >= 0.0


BOUNDED = BranchAndBound(max_cubes=2000)


def test_same_bytes_again(directions):
    rng = np.random.default_rng(9)
    estimator, value = BranchAndBound(), directions.room(rng, directions.rotation(rng), lines=(20, 20, 20), strays=20)
    first = estimator(*value, None)
    found = estimator(*value, None)
    assert found.rotations.tobytes() == first.rotations.tobytes() and found.gap == first.gap


WRONG = [{"inlier_deg": 30.0}, {"certificate_deg": 0.0}, {"max_gap": -0.1}, {"max_cubes": 0}, {"search_samples": 1}, {"plane_weight": -1.0}]


@pytest.mark.parametrize("wrong", [*WRONG, {"cone_deg": 0.0}])
def test_fields_out_of_range(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        BranchAndBound(**wrong)
