"""The picture of a run: that it is there, and that it shows what it is given."""

import sys

import cv2
import numpy as np
import pytest

from trihedron.pipeline.app import trajectory_plot as plot
from trihedron.pipeline.core.errors import DataError, LibraryError
from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.lie import exp_se3, exp_so3
from trihedron.pipeline.core.types import DEGRADED, LOST, OK, Trajectory


def circle(count: int = 90) -> Trajectory:
    angles = np.linspace(0.0, 5.0, count)
    poses = [pose_matrix(exp_so3(np.array([0.0, a, 0.0])), np.array([np.cos(a), 0.02 * a, np.sin(a)])) for a in angles]
    return Trajectory(np.arange(count, dtype=np.int64) * 33_333_333, np.array(poses))


def colors_in(path) -> set[tuple[int, int, int]]:
    image = cv2.imread(str(path))[:, :, ::-1]
    return {tuple(int(x) for x in color) for color in np.unique(image.reshape(-1, 3), axis=0)}


BLUE, GREEN, ORANGE, RED = (31, 119, 180), (44, 160, 44), (255, 127, 14), (214, 39, 40)


def test_with_truth_and_status(tmp_path):
    truth = circle()
    estimate = Trajectory(truth.stamps_ns, exp_se3(np.full(6, 0.3)) @ truth.poses)
    status = [(int(stamp), DEGRADED if 20 <= i < 40 else OK) for i, stamp in enumerate(truth.stamps_ns)]
    plot.trajectory_figure(estimate, truth, tmp_path / "t.png", status)
    found = colors_in(tmp_path / "t.png")
    assert {BLUE, GREEN, ORANGE} <= found
    assert RED not in found


def test_without_truth(tmp_path):
    plot.trajectory_figure(circle(), None, tmp_path / "t.png", [(100, LOST)])
    found = colors_in(tmp_path / "t.png")
    assert {BLUE, RED} <= found
    assert GREEN not in found


@pytest.mark.parametrize("count", [1, 2, 5])
def test_short_or_unrelated_trajectories_are_drawn_too(tmp_path, count):
    far = Trajectory(circle(50).stamps_ns + 10**12, circle(50).poses)
    plot.trajectory_figure(circle(count), far, tmp_path / "t.png")
    assert BLUE in colors_in(tmp_path / "t.png") or count == 1


def test_the_picture_does_not_depend_on_the_world_frame(tmp_path):
    truth, moved = circle(), exp_se3(np.full(6, 0.3))
    bent = truth.poses @ np.array([exp_se3(np.full(6, 0.02 * np.sin(i / 5.0))) for i in range(len(truth))])
    pictures = []
    for name, poses in (("a.png", bent), ("b.png", moved @ bent)):
        plot.trajectory_figure(Trajectory(truth.stamps_ns, poses), truth, tmp_path / name, [])
        pictures.append(cv2.imread(str(tmp_path / name)).astype(int))
    assert (np.abs(pictures[0] - pictures[1]).max(axis=2) > 64).mean() < 1e-3


def test_rotation_errors_do_not_depend_on_the_world_frame():
    truth = circle()
    bent = truth.poses @ pose_matrix(exp_so3(np.array([0.0, 0.0, 0.02])), np.zeros(3))
    half = np.where(np.arange(90)[:, None, None] < 45, truth.poses, bent)
    errors = plot._rotation_errors(exp_se3(np.full(6, 0.3)) @ half, truth.poses)
    assert errors.max() < np.degrees(0.02)
    assert plot._rotation_errors(exp_se3(np.full(6, 0.3)) @ truth.poses, truth.poses).max() < 1e-6


def test_a_line_is_broken_over_a_gap():
    stamps = np.array([0, 1, 2, 20, 21]) * 33_000_000
    assert np.isnan(plot._break_at_gaps(stamps, np.ones((5, 2)))).any(axis=1).tolist() == [False, False, False, True, False, False]


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(DataError) as error:
        plot.trajectory_figure(circle(), None, tmp_path / "no" / "t.png")
    assert str(error.value) == f"{tmp_path / 'no' / 't.png'}: cannot be written: No such file or directory; give another folder"


def test_a_run_without_matplotlib_says_that_it_draws_no_picture(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(LibraryError, match=r"^matplotlib: "):
        plot.trajectory_figure(circle(), None, tmp_path / "t.png")
    assert not (tmp_path / "t.png").exists()
