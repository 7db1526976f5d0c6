"""Trajectories of other programs in the table of `trihedron compare`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from trihedron.comparison.runs import read_runs, read_trajectories
from trihedron.datasets.readers.icl_nuim import reflect
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import DataError, UsageError
from trihedron.pipeline.core.types import Trajectory
from trihedron.pipeline.record.trajectories import read_trajectory, write_trajectory

SMALL = ["dataset.width=160", "dataset.height=120", "dataset.length=40"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "ours"
    assert main(["run", *SMALL, f"out={folder}"]) == 0
    return folder


def rounded(run: Path, file: Path, rows: slice = slice(None)) -> Path:
    """The run's trajectory as other programs write it: six decimals of the stamp."""
    lines = [line.split() for line in (run / "trajectory.txt").read_text().splitlines() if not line.startswith("#")]
    file.write_text("".join(f"{float(line[0]):.6f} {' '.join(line[1:])}\n" for line in lines[rows]))
    return file


def figures(run: Path, *files: Path, **options: object) -> list[dict[str, float]]:
    return [found.figures for found in read_trajectories(files, read_runs(run), **options)]  # type: ignore[arg-type]


def test_our_own_trajectory_is_judged_as_in_the_run(run: Path, tmp_path: Path) -> None:
    [found] = figures(run, rounded(run, tmp_path / "same.txt"))
    final = json.loads((run / "metrics.json").read_text())["final"]
    assert found["ATE mm"] == pytest.approx(1e3 * final["ate_rmse_m"], abs=1e-6) and found["tracked %"] == 100.0 * final["tracked_share"]
    assert found["RPE 1 s deg"] == pytest.approx(final["rpe_second_rmse_deg"], abs=1e-7) and np.isnan(found["p50 ms"])


def test_frames_it_did_not_track_count(run: Path, tmp_path: Path) -> None:
    [found] = figures(run, rounded(run, tmp_path / "half.txt", slice(0, 20)))
    assert found["tracked %"] == 50.0


def test_kitti_has_a_pose_for_each_frame(run: Path, tmp_path: Path) -> None:
    poses = read_trajectory(run / "trajectory.txt").poses
    file = tmp_path / "kitti.txt"
    np.savetxt(file, poses[:, :3].reshape(-1, 12))
    [found] = figures(run, file)
    assert found["ATE mm"] == pytest.approx(figures(run, rounded(run, tmp_path / "same.txt"))[0]["ATE mm"], abs=1e-6)
    np.savetxt(file, poses[:-1, :3].reshape(-1, 12))
    with pytest.raises(DataError) as caught:
        figures(run, file)
    assert caught.value.cause == f"39 poses without stamps fit 0 of 1 data sets (frames: 40 in {run})"


def test_y_up_is_mirrored_and_noticed(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ours = read_trajectory(run / "trajectory.txt")
    write_trajectory(tmp_path / "up.txt", Trajectory(ours.stamps_ns, reflect(ours.poses)))
    [found] = figures(run, tmp_path / "up.txt", y_up=True)
    assert found["ATE mm"] == pytest.approx(figures(run, run / "trajectory.txt")[0]["ATE mm"], abs=1e-4)
    assert capsys.readouterr().err == ""
    figures(run, tmp_path / "up.txt")
    assert "its turns fit better mirrored" in capsys.readouterr().err


def test_another_sequence_is_refused_and_a_few_other_frames_are_skipped(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ours = read_trajectory(run / "trajectory.txt")
    write_trajectory(tmp_path / "later.txt", Trajectory(ours.stamps_ns + 10**12, ours.poses))
    with pytest.raises(DataError, match=r"its stamps fit 0 of 1 data sets \(frames: 40 in .*\); give a run of the same frames"):
        figures(run, tmp_path / "later.txt")
    more = Trajectory(np.append(ours.stamps_ns, ours.stamps_ns[-1] + 10**9), np.concatenate([ours.poses, ours.poses[-1:]]))
    write_trajectory(tmp_path / "more.txt", more)
    assert figures(run, tmp_path / "more.txt") == figures(run, run / "trajectory.txt")
    assert "1 poses of frames that" in capsys.readouterr().err


def test_rows_have_labels_and_one_label_is_one_row(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(rounded(run, tmp_path / f"{k}.txt", slice(0, 40 - k))) for k in range(2)]
    assert main(["compare", str(run), *files, "--label", "ORB-SLAM2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [["-", "1"], ["ORB-SLAM2", "2"]] and "98.8 ±1.2" in lines[2]
    assert main(["compare", str(run), *files, "--baseline", "1"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]] == ["-", "0", "1"]
    with pytest.raises(UsageError, match="--label: there are 3 for 2 trajectories"):
        read_trajectories([Path(file) for file in files], read_runs(run), ["a", "b", "c"])
    with pytest.raises(UsageError, match="--label: there is no trajectory"):
        read_trajectories([], read_runs(run), ["a"])
