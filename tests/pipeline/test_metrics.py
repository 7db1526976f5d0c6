"""The figures of `metrics` against evo's, and against trajectories whose errors are known by construction."""

from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.lie import exp_se3, exp_so3
from trihedron.pipeline.core.types import Trajectory
from trihedron.pipeline.record.trajectories import read_trajectory
from trihedron.pipeline.run.metrics import associate, evaluate_trajectory, frame_errors

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
MS = 1_000_000


def walk(count: int, seed: int = 0, period_ns: int = 33_333_333) -> Trajectory:
    """A smooth random motion of about 1 cm and 0.5 degrees a frame."""
    rng = np.random.default_rng(seed)
    velocity = np.cumsum(rng.normal(0.0, 0.002, (count, 6)), axis=0) * 0.3
    poses = [np.eye(4)]
    for twist in velocity[1:]:
        poses.append(poses[-1] @ exp_se3(twist))
    return Trajectory(np.arange(count, dtype=np.int64) * period_ns, np.array(poses))


def noisy(truth: Trajectory, seed: int = 1, sigma_m: float = 0.01, sigma_rad: float = 0.01) -> Trajectory:
    """The truth in another world frame, with independent errors of each pose."""
    rng = np.random.default_rng(seed)
    other = exp_se3(rng.normal(0.0, 1.0, 6))
    scale = np.array([sigma_m] * 3 + [sigma_rad] * 3)
    return Trajectory(truth.stamps_ns, np.array([other @ pose @ exp_se3(rng.normal(0.0, 1.0, 6) * scale) for pose in truth.poses]))


def part(trajectory: Trajectory, rows) -> Trajectory:
    return Trajectory(trajectory.stamps_ns[rows], trajectory.poses[rows])


def evo_figures(estimate: Trajectory, truth: Trajectory, frames: int, max_difference_ns: int = 20 * MS) -> dict[str, float]:
    """What evo says of the same two trajectories."""
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D

    def convert(trajectory):
        return PoseTrajectory3D(poses_se3=list(trajectory.poses), timestamps=trajectory.stamps_ns / 1e9)

    reference, tracked = sync.associate_trajectories(convert(truth), convert(estimate), max_diff=max_difference_ns / 1e9)
    tracked.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, tracked))
    figures = {f"ate_{name}_m": float(value) for name, value in ape.get_all_statistics().items() if name in ("rmse", "mean", "median", "max")}
    for prefix, delta in (("rpe_frame", 1), ("rpe_second", frames)):
        for relation, unit in ((metrics.PoseRelation.translation_part, "m"), (metrics.PoseRelation.rotation_angle_deg, "deg")):
            rpe = metrics.RPE(relation, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
            rpe.process_data((reference, tracked))
            figures |= {f"{prefix}_{name}_{unit}": float(rpe.get_statistic(metrics.StatisticsType[name])) for name in ("rmse", "median")}
            figures[f"{prefix}_pairs"] = len(rpe.error)
    return figures


def assert_equal_to_evo(estimate: Trajectory, truth: Trajectory, fps: float, **options) -> None:
    ours = evaluate_trajectory(estimate, truth, fps, **options).to_dict()
    for name, value in evo_figures(estimate, truth, round(fps)).items():
        assert ours[name] == pytest.approx(value, abs=1e-9, rel=0), name


@pytest.mark.parametrize("seed", range(5))
def test_equal_to_evo_on_noisy_trajectories(seed):
    truth = walk(150, seed)
    assert_equal_to_evo(noisy(truth, seed + 10, 0.02 * seed, 0.05 * seed), truth, fps=30.0)


def test_equal_to_evo_where_truth_is_faster_and_shifted_in_time():
    truth = walk(1000, 3, 10 * MS)
    estimate = noisy(Trajectory(truth.stamps_ns + 3 * MS, truth.poses))
    assert_equal_to_evo(part(estimate, np.arange(40, 900, 3)), truth, fps=33.4)


@pytest.mark.parametrize(("name", "fps"), [("tum_fr3_structure_notexture_far", 30.0), ("icl_office_rendered", 30.0), ("icl_nuim_of_kt3", 30.0)])
def test_equal_to_evo_on_real_ground_truth(name, fps):
    if not (SHARED / name).is_dir():
        pytest.skip(f"{name} is not beside this checkout")
    truth = read_trajectory(SHARED / name / "groundtruth.txt")
    listed = SHARED / name / "depth.txt"
    if listed.is_file():  # at the images' stamps, two of three and with the frames the sensor dropped
        stamps = np.array([round(float(line.split()[0]) * 1e9) for line in listed.read_text().splitlines() if line[0] != "#"])
        pairs = associate(stamps, truth.stamps_ns)
        frames = Trajectory(stamps[pairs[:, 0]], truth.poses[pairs[:, 1]])
    else:
        frames = part(truth, np.arange(59))
    assert_equal_to_evo(noisy(frames), truth, fps)
    assert_equal_to_evo(noisy(frames), truth, fps, frame_stamps_ns=frames.stamps_ns)


def test_a_rigid_motion_of_the_truth_has_no_error():
    metrics = evaluate_trajectory(noisy(walk(60), sigma_m=0.0, sigma_rad=0.0), walk(60), fps=30)
    assert metrics.ate_max_m < 1e-12
    assert metrics.rpe_second_rmse_deg < 1e-9
    assert (metrics.rpe_frame_pairs, metrics.rpe_second_pairs, metrics.tracked_share) == (59, 30, 1.0)


def test_scale_is_not_aligned():
    truth = walk(60)
    estimate = truth.poses.copy()
    estimate[:, :3, 3] *= 1.1
    centred = truth.poses[:, :3, 3] - truth.poses[:, :3, 3].mean(axis=0)
    expected = 0.1 * np.sqrt((centred**2).sum(axis=1).mean())
    assert evaluate_trajectory(Trajectory(truth.stamps_ns, estimate), truth).ate_rmse_m == pytest.approx(expected, abs=1e-12)


def test_rpe_of_a_constant_drift():
    """An estimate that turns 0.1 degrees and creeps 1 mm too far each frame."""
    stamps = np.arange(50, dtype=np.int64) * 33_333_333
    truth = Trajectory(stamps, np.tile(np.eye(4), (50, 1, 1)))
    step = pose_matrix(exp_so3(np.radians([0.0, 0.1, 0.0])), np.array([0.0, 0.001, 0.0]))
    metrics = evaluate_trajectory(Trajectory(stamps, np.array([np.linalg.matrix_power(step, i) for i in range(50)])), truth, fps=30)
    assert metrics.rpe_frame_rmse_deg == pytest.approx(0.1, abs=1e-9)
    assert metrics.rpe_frame_median_m == pytest.approx(0.001, abs=1e-12)
    assert metrics.rpe_second_rmse_deg == pytest.approx(3.0, abs=1e-9)
    assert metrics.rpe_second_rmse_m == pytest.approx(0.03, abs=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_poses_on_both_sides_of_a_gap_are_not_consecutive(known):
    truth = walk(60)
    kept = np.r_[0:20, 24:60]
    metrics = evaluate_trajectory(part(noisy(truth), kept), truth, fps=30, frame_stamps_ns=truth.stamps_ns if known else None)
    assert metrics.rpe_frame_pairs == 54  # 55 steps between 56 poses, and one is 5 frames long
    assert metrics.rpe_second_pairs == sum(i + 30 in set(kept) for i in kept)


def test_known_frames_number_the_poses_whatever_their_stamps():
    truth = walk(60)
    jumps = truth.stamps_ns + np.where(np.arange(60) > 30, 500 * MS, 0)
    moved = Trajectory(jumps, truth.poses)
    assert evaluate_trajectory(noisy(moved), moved, frame_stamps_ns=jumps).rpe_frame_pairs == 59
    assert evaluate_trajectory(noisy(moved), moved).rpe_frame_pairs == 58


def test_share_of_the_frames_with_truth():
    truth = walk(300, period_ns=10 * MS)  # 100 Hz, from 0 to 2.99 s
    frames = np.arange(-15, 90) * 33_333_333  # the first 15 frames have no truth
    tracked = frames[5:60]  # 45 of the 90 frames with truth, 10 poses have none
    estimate = Trajectory(tracked, np.tile(np.eye(4), (55, 1, 1)))
    exact = evaluate_trajectory(estimate, truth, frame_stamps_ns=frames)
    assert (exact.poses, exact.poses_with_truth, exact.frames_with_truth, exact.share_basis) == (55, 45, 90, "frames")
    assert (exact.tracked_share, exact.tracked_share_in_span) == (0.5, 1.0)
    guessed = evaluate_trajectory(estimate, truth)
    assert (guessed.frames_with_truth, guessed.share_basis) == (90, "ground truth")
    assert guessed.tracked_share == 0.5


def test_share_without_frames_counts_what_was_lost_at_the_end_and_in_between():
    truth = walk(100)
    metrics = evaluate_trajectory(part(noisy(truth), np.r_[0:40, 50:80]), truth)
    assert metrics.tracked_share == 0.70
    assert metrics.tracked_share_in_span == 70 / 80


def test_each_frame_counts_once():
    """Poses twice as often as truth: each truth has one pose, and the share is no more than 1."""
    truth = walk(50)
    stamps = np.sort(np.r_[truth.stamps_ns, truth.stamps_ns + 5 * MS])
    estimate = Trajectory(stamps, np.repeat(truth.poses, 2, axis=0))
    metrics = evaluate_trajectory(estimate, truth)
    assert (metrics.poses, metrics.poses_with_truth, metrics.tracked_share) == (100, 50, 1.0)
    assert metrics.ate_max_m < 1e-12  # the nearer pose of each two


def test_associate_takes_the_nearest_first_and_each_stamp_once():
    estimate = np.array([0, 10, 30, 100, 200]) * MS
    truth = np.array([8, 25, 35, 121, 220]) * MS
    assert associate(estimate, truth).tolist() == [[1, 0], [2, 1], [4, 4]]  # 10-8; 30-25, the earlier of two; 200-220, just within
    assert associate(estimate, truth, 2 * MS).tolist() == [[1, 0]]
    assert associate(estimate[:0], truth).shape == (0, 2)


def test_associate_gives_a_pose_its_second_choice_when_a_nearer_pose_has_the_first():
    assert associate(np.array([20, 26]) * MS, np.array([5, 25]) * MS).tolist() == [[0, 0], [1, 1]]
    assert associate(np.array([26, 27]) * MS, np.array([5, 25]) * MS).tolist() == [[0, 1]]


def test_short_trajectories_have_no_rpe_over_a_second():
    metrics = evaluate_trajectory(noisy(walk(10)), walk(10), fps=30)
    assert metrics.rpe_second_rmse_m is None
    assert (metrics.rpe_second_frames, metrics.rpe_second_pairs) == (30, 0)


def test_fps_comes_from_the_stamps():
    truth = walk(100, period_ns=100 * MS)
    assert evaluate_trajectory(noisy(truth), truth).rpe_second_frames == 10


def test_poses_that_are_not_finite():
    poses = walk(10).poses.copy()
    poses[4, 0, 3], poses[7, 1, 1] = np.nan, np.inf
    with pytest.raises(DataError) as error:
        evaluate_trajectory(Trajectory(walk(10).stamps_ns, poses), walk(10), names=("a.txt", "b.txt"))
    assert str(error.value) == "a.txt: 2 of 10 poses are not finite, the first at 0.133333 s; remove the frames that have no pose"


def test_stamps_that_go_backwards():
    truth = walk(10)
    with pytest.raises(DataError) as error:
        evaluate_trajectory(truth, part(truth, [0, 1, 3, 2, 4]))
    assert str(error.value) == "ground truth: the stamps do not increase at 0.066667 s; sort the poses, one a stamp"


def test_no_overlap_in_time():
    truth = walk(10)
    late = Trajectory(truth.stamps_ns + 10_000 * MS, truth.poses)
    with pytest.raises(DataError) as error:
        evaluate_trajectory(late, truth, names=("a.txt", "b.txt"))
    expected = "a.txt: no overlap in time with b.txt: 10.000 to 10.300 s against 0.000 to 0.300 s; give files of the same clock"
    assert str(error.value) == expected


def test_too_few_poses_with_truth():
    truth = walk(10, period_ns=100 * MS)
    with pytest.raises(DataError) as error:
        evaluate_trajectory(Trajectory(truth.stamps_ns + 40 * MS, truth.poses), truth, names=("a.txt", "b.txt"))
    assert str(error.value) == (
        "a.txt: 0 of 10 poses have truth within 20 ms in b.txt, 3 are needed; "
        "give files of the same clock (0.040 to 0.940 s against 0.000 to 0.900 s) or allow a larger difference"
    )
    with pytest.raises(DataError) as error:
        evaluate_trajectory(part(truth, [0, 1]), truth)
    assert str(error.value) == "trajectory: has 2 poses; an evaluation needs at least 3"


def test_the_errors_of_frames_have_the_root_mean_squares_of_the_metrics():
    truth = walk(80)
    estimate = part(noisy(truth), np.r_[0:20, 23:70])
    metrics = evaluate_trajectory(estimate, truth, 30.0, truth.stamps_ns).to_dict()
    errors = frame_errors(estimate, truth, 30.0, truth.stamps_ns)
    assert sorted(errors) == ["ate_rmse_m", "rpe_frame_rmse_deg", "rpe_frame_rmse_m", "rpe_second_rmse_deg", "rpe_second_rmse_m"]
    for name, values in errors.items():
        assert values.shape == (80,) and np.sqrt(np.nanmean(values**2)) == pytest.approx(metrics[name], rel=1e-12), name
    assert np.flatnonzero(np.isnan(errors["ate_rmse_m"])).tolist() == [20, 21, 22, *range(70, 80)]
    assert np.flatnonzero(np.isnan(errors["rpe_frame_rmse_m"])).tolist() == [19, 20, 21, 22, *range(69, 80)]  # the first frame of a pair
    assert frame_errors(part(estimate, np.r_[0:2]), truth, 30.0, truth.stamps_ns) == {}
