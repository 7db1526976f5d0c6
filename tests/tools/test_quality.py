"""Quality without ground truth: nothing to complain about on true poses, and more the further they are off."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import F64, Frame
from trihedron.tools.quality import Parts, PosedFrames, Quality, _orthogonal, quality_of, wall_thickness, warped_depth

COUNT, STEP = 48, 2  # frames of the room, and how many of its own they are apart


@cache
def room() -> Synthetic:
    return Synthetic(length=STEP * COUNT, width=160, height=120, texture=False, noise=False)


@cache
def frame(row: int) -> Frame | None:
    return room()(STEP * row)


def judged(poses: F64) -> Quality:
    return quality_of(PosedFrames(np.arange(COUNT), poses, frame), COUNT)


def off_by(sigma_m: float) -> Quality:
    rng = np.random.default_rng(0)
    moved = np.array([exp_se3(np.concatenate([sigma_m * rng.standard_normal(3), np.zeros(3)])) for _ in range(COUNT)])
    return judged(np.array([room().true_pose(STEP * row) for row in range(COUNT)]) @ moved)


@pytest.fixture(scope="module")
def found() -> list[Quality]:
    return [off_by(sigma) for sigma in (0.0, 0.01, 0.04)]


def test_true_poses_agree(found: list[Quality]) -> None:
    true = found[0]
    assert (true.frames, true.posed) == (COUNT, COUNT) and true.parts > 100
    for value in (true.warped_1_m, true.warped_10_m, true.warped_30_m):
        assert value is not None and value < 6e-3  # the nearest pixel's depth, on slanted walls
    assert true.wall_thickness_m is not None and true.wall_thickness_m < 2e-3
    assert true.plane_sigma_m is not None and true.plane_sigma_m < 8e-3


def test_every_figure_grows_with_the_error(found: list[Quality]) -> None:
    for name in ("warped_1_m", "warped_10_m", "warped_30_m", "shifted_30_m", "map_entropy", "plane_sigma_m", "wall_thickness_m"):
        values = [getattr(quality, name) for quality in found]
        assert values == sorted(values) and values[0] < values[2], name
    thickness = found[2].wall_thickness_m
    assert thickness is not None and 0.015 < thickness < 0.05  # of few frames a part: the median of such variances is less than their mean


def test_depth_is_warped_by_the_motion_between_both_frames() -> None:
    a = frame(0)
    assert a is not None
    ahead = np.eye(4)
    ahead[2, 3] = 0.1  # frame b is 10 cm behind a: its depths are that much larger, but nothing has moved in the image it measured
    compared = warped_depth(a, a, np.eye(4))
    assert compared == (0.0, 0.0)
    moved = warped_depth(a, a, ahead)
    assert moved is not None and moved[0] == pytest.approx(0.1, abs=0.02)
    behind = np.diag([1.0, -1.0, -1.0, 1.0])
    assert warped_depth(a, a, behind) is None


def test_orthogonal_directions_are_found_and_others_left_out() -> None:
    x, y, z = np.eye(3)
    slanted = np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0)
    normals = np.array([x, -x, x, y, y, z, slanted])
    assert _orthogonal(normals).tolist() == [0, 1, 2, 3, 4, 5]
    assert len(_orthogonal(np.array([x, x, slanted]))) == 0
    assert len(_orthogonal(np.zeros((0, 3)))) == 0


def test_walls_are_as_thick_as_the_frames_disagree() -> None:
    rng = np.random.default_rng(0)
    points, views = rng.uniform(-0.1, 0.1, (4000, 3)), np.repeat(np.arange(4), 1000)
    points[:, 2] = 0.02 * rng.standard_normal(4000) + np.array([-0.03, 0.03, -0.03, 0.03])[views]
    part = Parts(np.array([[1e-4, 1.0, 1.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([True]), [np.arange(4000)])
    assert wall_thickness(points, views, part, [0]) == pytest.approx(np.std([-0.03, 0.03, -0.03, 0.03], ddof=1), rel=0.05)
    assert wall_thickness(points, np.zeros(4000, np.int64), part, [0]) is None


def test_a_run_is_judged_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["dataset.width=160", "dataset.height=120", "dataset.length=20", "outputs=[trajectory]"]
    assert main(["run", *small, f"out={tmp_path / 'run'}"]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "run"), "--no-reference", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["frames"] == 20 and 0.0 < figures["warped_1_m"] < 0.05 and figures["warped_30_m"] is None
    stated = json.loads((tmp_path / "run" / "metrics.json").read_text())["sigma"]
    assert figures["sigma_m"] == pytest.approx(stated["median_m"]) and 0.0 < figures["sigma_m"] < 0.05
    assert main(["evaluate", str(tmp_path / "run"), "--no-reference"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["figure", "without", "truth", "value", "by", "the", "ground", "truth"]
    exact = f"{1e3 * figures['truth']['warped_1_m']:.2f} mm"
    assert next(line for line in lines if line.startswith("warped_1 ")).endswith(exact)
    assert figures["truth"]["warped_1_m"] == pytest.approx(figures["warped_1_m"], rel=0.2) and figures["truth"]["sigma_m"] is None


def test_a_truth_is_either_given_or_not_wanted(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "a", "b", "--no-reference"]) == 2
    assert capsys.readouterr().err == "trihedron: evaluate: --no-reference takes no TRUTH; see trihedron evaluate --help\n"
    assert main(["evaluate", "a"]) == 2
    assert capsys.readouterr().err == "trihedron: evaluate: the following arguments are required: TRUTH; see trihedron evaluate --help\n"
