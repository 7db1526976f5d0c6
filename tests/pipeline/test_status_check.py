"""Wrong `ok`: frames whose errors exceed what they state, in each sub-map by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import LOST, OK, Pose, Trajectory
from trihedron.pipeline.run.status_check import check_status, name_of_test, sigma_auc

SOMEWHERE = exp_se3(np.array([3.0, -1.0, 2.0, 0.4, -2.0, 1.0]))


def run_of(count: int = 400, sigma: float = 0.004, submap_from: int = 10**9) -> tuple[list[Pose], Trajectory]:
    """Poses along a curve with honest errors of σ along and about each axis, in another world than the truth; a sub-map has a world of its own."""
    rng = np.random.default_rng(0)
    truth = np.array([exp_se3(np.array([np.cos(t), np.sin(2 * t), 0.3 * t, 0.2 * np.sin(t), t, 0.1])) for t in np.linspace(0, 6, count)])
    stamps = np.arange(count, dtype=np.int64) * 33_333_333
    poses = []
    for i in range(count):
        world = np.eye(4) if i < submap_from else SOMEWHERE
        T = world @ truth[i] @ exp_se3(-sigma * rng.standard_normal(6))
        submap = int(i >= submap_from)
        poses.append(Pose(i, int(stamps[i]), T, sigma**2 * np.eye(6), np.eye(4), -1, np.array([9, 0, 0], np.int32), 0, OK, "", submap))
    return poses, Trajectory(stamps, SOMEWHERE @ truth)


def test_honest_poses_are_honest_and_none_is_wrong() -> None:
    poses, truth = run_of()
    check, errors = check_status(poses, truth)
    assert (check.frames, check.ok, check.degraded, check.lost, check.wrong_ok) == (400, 400, 0, 0, 0)
    assert check.ate_m == pytest.approx(0.004 * np.sqrt(3), rel=0.05)
    assert check.nees_median is not None and 3.0 < check.nees_median < 6.0  # errors independent from frame to frame count as the truth's, too
    assert check.share_within_95 is not None and check.share_within_95 > 0.94
    assert check.steps == 399 and check.steps_within_50mm == 1.0
    assert errors.judged.all()


@pytest.mark.parametrize(
    "moved, sigma, wrong",
    [
        (np.array([0.08, 0, 0, 0, 0, 0]), 0.004, 5),  # 8 cm at 4 mm
        (np.array([0.08, 0, 0, 0, 0, 0]), 0.03, 0),  # 8 cm at 3 cm is within 4 σ
        (np.array([0.03, 0, 0, 0, 0, 0]), 0.004, 0),  # 3 cm is less than the 5 cm
        (np.array([0, 0, 0, 0, np.radians(3.0), 0]), 0.004, 5),  # 3° at 0.23°
    ],
)
def test_ok_frames_that_are_off_by_more_than_they_state_are_wrong(moved: np.ndarray, sigma: float, wrong: int) -> None:
    poses, truth = run_of()
    for i in range(100, 105):
        poses[i] = replace(poses[i], T_world_camera=poses[i].T_world_camera @ exp_se3(moved), covariance=sigma**2 * np.eye(6))
    assert check_status(poses, truth)[0].wrong_ok == wrong
    for i in range(100, 105):
        poses[i] = replace(poses[i], status="degraded", reason="doubt")
    assert check_status(poses, truth)[0].wrong_ok == 0


@pytest.mark.parametrize("stated, wrong", [(True, False), (False, True)])
def test_a_drift_that_is_stated_is_not_wrong_where_it_began(stated: bool, wrong: bool) -> None:
    poses, truth = run_of()
    for i, pose in enumerate(poses):
        drift = 0.001 * i  # 40 cm at the end, of which an alignment over all puts 20 cm to the start
        sigma = max(drift, 0.004) if stated else 0.004
        T = exp_se3(np.array([drift, 0, 0, 0, 0, 0])) @ pose.T_world_camera
        poses[i] = replace(pose, T_world_camera=T, covariance=sigma**2 * np.eye(6))
    check, errors = check_status(poses, truth)
    assert errors.error_m[:40].min() > 0.05 and errors.sigma_m[:40].max() < 0.04
    assert (check.wrong_ok > 0) == wrong


def test_each_sub_map_is_aligned_by_itself_and_lost_frames_do_not_count() -> None:
    poses, truth = run_of(submap_from=200)
    poses[300] = replace(poses[300], status=LOST, reason="covered", T_world_camera=np.eye(4))
    check, errors = check_status(poses, truth)
    assert (check.ok, check.lost, check.wrong_ok) == (399, 1, 0)
    assert check.ate_m == pytest.approx(0.004 * np.sqrt(3), rel=0.05)
    joined, _ = check_status([replace(pose, submap=0) for pose in poses], truth)
    assert joined.wrong_ok > 150
    assert len(errors.error_m) == 399


def test_the_spread_is_that_of_the_errors_where_sigma_is_honest_and_follows_it() -> None:
    poses, truth = run_of()
    honest = check_status(poses, truth)[0].spread_over_error
    poses = [replace(pose, covariance=9.0 * pose.covariance) for pose in poses]
    cautious = check_status(poses, truth)[0].spread_over_error
    assert honest is not None and 1.0 < honest < 1.5  # errors independent from frame to frame count as the truth's, too
    assert cautious is not None and cautious > 2.0 * honest
    unknown = check_status(poses, Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4))))[0]
    assert (unknown.ok, unknown.ate_m, unknown.spread_over_error) == (400, None, None)


def test_frames_that_are_not_ok_are_counted_by_the_test() -> None:
    poses, truth = run_of()
    for i, (status, reason) in enumerate([("degraded", "only 5 of 40 matches agree"), ("degraded", "only 7 of 9 matches agree"), (LOST, "covered")]):
        poses[i] = replace(poses[i], status=status, reason=reason)
    assert check_status(poses, truth)[0].not_ok == {"only … of … matches agree": 2, "covered": 1}


@pytest.mark.parametrize(
    "reason, test",
    [
        ("something moves: only 5 of 40 matches agree", "something moves"),
        ("in sub-map 2, which is not merged with the first yet: 3 points", "in sub-map …"),
        ("images are 0.31 px off, 4.2 times what is stated", "images are … px off"),
        ("", "no reason"),
    ],
)
def test_a_test_is_named_by_the_first_clause_of_its_reason_without_figures(reason: str, test: str) -> None:
    assert name_of_test(reason) == test


def test_sigma_tells_large_errors_from_small_ones() -> None:
    error = np.arange(100.0)
    assert sigma_auc(error, error) == 1.0
    assert sigma_auc(error, -error) == 0.0
    assert sigma_auc(error, np.ones(100)) == 0.5
    assert sigma_auc(np.ones(9), np.ones(9)) is None
    assert sigma_auc(np.zeros(0), np.zeros(0)) is None


def test_sigma_of_a_drift_is_compared_in_the_world_of_the_first_camera() -> None:
    """A drift that is stated tells early frames from late ones, although the alignment of the ATE spreads it over all of them."""
    poses, truth = run_of(sigma=0.0005)
    sigmas = 0.0005 + 0.05 * np.linspace(0.0, 1.0, len(poses))
    drifting = []
    for pose, sigma in zip(poses, sigmas):
        off = exp_se3(np.array([sigma, 0.5 * sigma, 0.0, 0.0, 0.0, 0.0]))
        drifting.append(replace(pose, T_world_camera=off @ pose.T_world_camera, covariance=sigma**2 * np.eye(6)))
    check, errors = check_status(drifting, truth)
    assert check.sigma_auc is not None and check.sigma_auc > 0.95
    by_alignment = sigma_auc(errors.error_m, errors.sigma_m)
    assert by_alignment is not None and by_alignment < 0.7


def test_a_run_without_poses_has_no_figures() -> None:
    poses, truth = run_of(20)
    check, _ = check_status([replace(pose, status=LOST, reason="covered") for pose in poses], truth)
    assert (check.lost, check.ate_m, check.nees_median, check.sigma_auc, check.steps_within_50mm) == (20, None, None, None, None)


def test_a_world_is_aligned_by_the_frames_that_are_ok() -> None:
    """Frames that claim nothing do not move the alignment: 100 degraded ones are 1 m off, the others as good as they say."""
    poses, truth = run_of()
    for i in range(300, 400):
        poses[i] = replace(poses[i], status="degraded", T_world_camera=poses[i].T_world_camera @ exp_se3(np.array([1.0, 0, 0, 0, 0, 0])))
    check, errors = check_status(poses, truth)
    assert check.wrong_ok == 0 and errors.error_m[errors.ok].max() < 0.05 < errors.error_m[~errors.ok].min()


def test_the_pose_that_defines_the_world_is_never_wrong() -> None:
    poses, truth = run_of()
    poses[0] = replace(poses[0], T_world_camera=poses[0].T_world_camera @ exp_se3(np.array([0.2, 0, 0, 0, 0, 0])), covariance=1e-12 * np.eye(6))
    check, errors = check_status(poses, truth)
    assert check.wrong_ok == 0 and errors.exact.tolist() == [True, *[False] * 399]
