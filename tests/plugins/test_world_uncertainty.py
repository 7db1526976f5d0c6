"""Covariance of a refined pose in the world, on errors that are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from trihedron.pipeline.core.table import Column, Table
from trihedron.pipeline.core.types import Map, Pose
from trihedron.plugins.pose.map_alignment_kernels import number_keyframes
from trihedron.plugins.pose.world_uncertainty import (
    keyframe_covariance,
    keyframe_uncertainty,
    propagate_world_covariance,
    without_chance_agreement,
)
from trihedron.plugins.pose.world_uncertainty_kernels import covariance_of_keyframes, residual_scale
from trihedron.plugins.shared.calibration_error_kernels import Observers
from trihedron.plugins.shared.pose_optimizer_kernels import Flags, Groups


def equations(rng, groups, common):
    """Information (k, 6, 6) of groups of 40 residuals of unit variance, and their scores where residuals of one group share `common` of it."""
    J = rng.normal(0, 1, (groups, 40, 6))
    shared = np.sqrt(common) * rng.normal(0, 1, (groups, 1, 6)) @ J.transpose(0, 2, 1)
    residuals = rng.normal(0, 1, (groups, 40)) + shared[:, 0]
    return J.transpose(0, 2, 1) @ J, np.einsum("kni,kn->ki", J, residuals)


@pytest.mark.parametrize("common, expected", [(0.0, 1.0), (0.1, 5.2)])
def test_scale_of_residuals_shows_what_those_of_one_keyframe_share(common, expected):
    """A pose error of variance c, common to a group, adds H c H to the covariance H of its score: the factor is about 1 + 40 c."""
    rng = np.random.default_rng(0)
    scales = [residual_scale(*equations(rng, 8, common)) for _ in range(400)]
    assert np.mean(scales) == pytest.approx(expected, rel=0.08)


def test_scale_of_residuals_is_unknown_for_one_keyframe_and_without_any():
    rng = np.random.default_rng(1)
    assert np.isnan(residual_scale(*equations(rng, 1, 0.0)))
    assert np.isnan(residual_scale(np.zeros((0, 6, 6)), np.zeros((0, 6))))


def test_keyframes_of_landmarks_are_numbered_in_the_order_of_time():
    created = Groups(*(np.array(rows, np.int32) for rows in ([7, 2, 7], [], [5])))
    observed = Observers(np.array([[7, -1], [2, 9], [7, -1]], np.int32), np.array([[3, 7]], np.int32), np.array([[5, -1]], np.int32))
    assert number_keyframes(12, created, observed).tolist() == [2, 3, 5, 7, 9]
    assert [part.tolist() for part in (*created, *observed)] == [[3, 0, 3], [], [2], [[3, -1], [0, 4], [3, -1]], [[1, 3]], [[2, -1]]]


@pytest.mark.parametrize("agree, kept", [(2, False), (3, True), (0, True)])
def test_a_few_old_landmarks_agree_by_chance(agree, kept):
    """Of six matches with landmarks that keyframe 30 was the last to observe, of points, a line and a wall, so many are inliers, beside those of
    keyframe 45; the reference keyframe is the 50th. A relation of planes is none of them."""
    rows = np.array([3, 30, 45, 50], np.int32)
    observed = Observers(
        np.array([[1, 0]] * 4 + [[2, 0]] * 5, np.int32), np.array([[-1, 1], [2, -1]], np.int32), np.array([[1, -1], [3, 2]], np.int32)
    )
    old = np.arange(6) < agree
    flags = Flags(*(np.array(kind, np.uint8) for kind in ([*old[:4], 1, 1, 1, 1, 0], [old[4], 1], [old[5], 1, 1])))
    found = without_chance_agreement(flags, observed, rows, 50)
    wanted = flags if kept else Flags(*(np.array(kind, np.uint8) for kind in ([0] * 4 + [1, 1, 1, 1, 0], [0, 1], [0, 1, 1])))
    assert all(np.array_equal(*kinds) for kinds in zip(found, wanted))
    assert [kind.sum() for kind in flags] == [4 + old[:4].sum(), 1 + old[4], 2 + old[5]]  # the given ones stay


def test_average_of_a_random_walk():
    """Keyframes of a random walk: the stated covariance of their weighted average is that of simulated walks."""
    rng, steps = np.random.default_rng(2), np.array([1.0, 2.0, 0.5, 4.0])
    variance, shares = np.cumsum(steps), np.array([0.4, 0.1, 0.2, 0.3])
    walks = np.cumsum(rng.normal(0, np.sqrt(steps), (200_000, 4)), axis=1)
    poses, information = np.tile(np.eye(4), (4, 1, 1)), shares[:, None, None] * np.tile(1e9 * np.eye(6), (4, 1, 1))
    stated = covariance_of_keyframes(np.eye(4), poses, variance[:, None, None] * np.eye(6), information)
    assert stated == pytest.approx((walks @ shares).var() * np.eye(6), rel=0.02, abs=1e-9)


def test_a_pose_that_was_not_refined_carries_the_uncertainty_of_the_map():
    """A camera 2 m from the previous one: a common rotation of the map moves it sideways."""
    previous = Pose(0, 0, np.eye(4), 5.0 * np.eye(6), np.eye(4), 0, np.zeros(3, np.int32), 0, "ok", "", 0, 0, np.diag([0, 0, 0, 1e-4, 0, 0]), 2.0)
    T = np.eye(4)
    T[2, 3] = 2.0
    pose = propagate_world_covariance(Pose(1, 1, T, np.eye(6), np.eye(4), 0, np.zeros(3, np.int32), 0, "degraded", ""), previous)
    assert pose.map_covariance[[1, 3, 0], [1, 3, 0]] == pytest.approx([4e-4, 1e-4, 0.0])
    assert pose.noise_scale == 2.0 and pose.local_covariance == pytest.approx(np.eye(6))
    assert pose.covariance == pytest.approx(2.0 * np.eye(6) + pose.map_covariance)


def map_of(sigmas_m, *first):
    """A map of keyframes at the origin with these standard deviations of their positions, and of landmarks that these keyframes created."""
    none = Table.empty({"first": Column("i4")})
    covariance = np.array([np.diag([0.25 * s * s, s * s, 0.5 * s * s, 1.0, 1.0, 1.0]) for s in sigmas_m])
    columns = {"T_world_camera": Column("f8", (4, 4)), "covariance": Column("f8", (6, 6))}
    keyframes, _ = Table.empty(columns).appended(T_world_camera=np.tile(np.eye(4), (len(covariance), 1, 1)), covariance=covariance)
    landmarks = [none.appended(first=np.asarray(rows, np.int32))[0] if len(rows) else none for rows in first]
    return Map(0, 0, 0, keyframes, *landmarks, none, none, none)


def test_a_pose_is_as_uncertain_as_the_median_of_its_landmarks_keyframes():
    """A line counts like two points and a plane like five; landmarks of the first keyframe, which is exact, do not make a far one exact."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        sigmas_m = np.concatenate([[1e-4], rng.uniform(0.01, 0.1, 7)])
        first = [rng.integers(0, 8, count) for count in (9, 4, 2)]
        found = keyframe_uncertainty(map_of(sigmas_m, *first), *(np.arange(len(rows), dtype=np.int32) for rows in first))
        each = np.sort(np.concatenate([np.repeat(sigmas_m[rows], score) for rows, score in zip(first, (1, 2, 5))]))
        assert found.sigma_m == pytest.approx(each[len(each) // 2]) == pytest.approx(sigmas_m[found.keyframe])
    nothing = np.zeros(0, np.int32)
    assert keyframe_uncertainty(map_of([0.1], [], [], []), nothing, nothing, nothing).keyframe == -1


def test_uncertain_keyframes_count_once_in_the_world_and_in_the_weights_of_landmarks():
    """Keyframes of σ 3 cm, a pose of σ 1 mm relative to them: landmarks made from it count both; a pose of σ 2 cm has that in its own."""
    count, rows = 4, np.arange(4, dtype=np.int32)
    map = map_of(np.full(count, 0.03), rows, [], [])
    problem = SimpleNamespace(map=map, landmarks=lambda solution: (rows, np.zeros(0, np.int32), np.zeros(0, np.int32)))
    certain, vague = (SimpleNamespace(T_world_camera=np.eye(4), covariance=sigma_m**2 * np.eye(6)) for sigma_m in (1e-3, 0.02))
    shared = keyframe_covariance(certain, problem, 3.0)
    assert np.diag(shared)[:3] == pytest.approx(0.03**2 * np.array([0.25, 1.0, 0.5])) and not keyframe_covariance(vague, problem, 3.0).any()
    noise, drift = 2.0, 0.05**2 * np.eye(6)
    stamps = 0, 0, np.eye(4), noise * certain.covariance + drift, np.eye(4), 0, np.zeros(3, np.int32), 0, "ok", ""
    pose = Pose(*stamps, map_covariance=drift, noise_scale=noise, keyframe_covariance=shared)
    assert pose.local_covariance == pytest.approx(certain.covariance + shared)
