"""σ of the ok poses: the figures of constructed poses, and the line that a run prints."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.registry import load_plugins
from trihedron.pipeline.core.types import DEGRADED, LOST, OK, Pose
from trihedron.pipeline.run.stated_sigma import CAUSES, calibration_variance_m2, dominant_cause, sigma_line, stated_sigma
from trihedron.plugins.shared.calibration_error import IMPRECISION

RUN = Path("runs/a")


@pytest.fixture(scope="module", autouse=True)
def plugins():
    """They know what is due to the calibration."""
    load_plugins()


def pose(noise_mm=1.0, drift_mm=0.0, calibration_mm=0.0, deg=0.1, status=OK, features=100, **fields):
    """A pose whose position has these σ, by cause, in the direction x; parameters of the calibration have a σ of 1 as long as nothing is known."""
    sensitivity = np.zeros((6, 12))
    sensitivity[0, 2] = calibration_mm * 1e-3
    of_map = np.diag([(drift_mm**2 + calibration_mm**2) * 1e-6, 0, 0, 0, 0, 0])
    covariance = of_map + np.diag([noise_mm**2 * 1e-6, 0, 0, 0, np.radians(deg) ** 2, 0])
    inliers = np.array([features, 0, 0], np.int32)
    known = Pose(0, 0, np.eye(4), covariance, np.eye(4), -1, inliers, 0, status, "", map_covariance=of_map, sensitivity=sensitivity)
    return replace(known, **fields)


def sigma_of(poses):
    poses = [replace(pose, index=k) for k, pose in enumerate(poses)]
    return stated_sigma(poses, [calibration_variance_m2(pose) for pose in poses])


FIRST = pose(900.0)  # exact by definition, whatever it states


def test_figures_and_line():
    poses = [FIRST, pose(1.0, 2.0, 2.0, 0.05), pose(1.0, 2.0, 2.0, 0.05), pose(2.0, 6.0, 3.0, 0.2), pose(99.0, status=DEGRADED)]
    found = sigma_of(poses)
    assert (found.poses, found.few_features) == (3, 0)
    assert [found.median_m, found.worst_m] == pytest.approx([3e-3, 7e-3]) and [found.median_deg, found.worst_deg] == pytest.approx([0.05, 0.2])
    calibration = 17 * (1 + IMPRECISION**2)
    assert found.share == pytest.approx({"noise": 6 / 67, "drift": (61 - calibration) / 67, "calibration": calibration / 67, "depth_scale": 0.0})
    line = "σ of ok poses: 3.0 mm, 0.05° (median), 7.0 mm, 0.20° (worst); mostly drift of the map"
    assert sigma_line(found.to_dict(), RUN) == line


@pytest.mark.parametrize(
    ("causes", "said"),
    [
        ((3.0, 1.0, 2.0), "; mostly noise of the measurements: turn slower, or give more light"),
        ((1.0, 3.0, 2.0), "; mostly drift of the map"),
        ((1.0, 2.0, 3.0), "; mostly the calibration: trihedron calibrate runs/a"),
        ((3.0, 0.0, 0.0), ""),  # one covariance alone: nothing is known of causes
    ],
)
def test_what_dominates_is_said_with_its_cure(causes, said):
    line = sigma_line(sigma_of([FIRST, pose(*causes)]).to_dict(), RUN)
    assert line.partition("(worst)")[2] == said


def test_a_calibrated_run_is_not_told_to_calibrate():
    line = sigma_line(sigma_of([FIRST, pose(1.0, 2.0, 3.0)]).to_dict(), RUN, calibrated=True)
    assert line.partition("(worst)")[2] == "; mostly the calibration: state how well the camera is known, as sigmas in camera.yaml"


def test_the_scale_of_depth_is_a_cause_of_its_own():
    """0.5 % of 2 m, beside 3 mm of noise and 4 of drift."""
    moved = np.eye(4)
    moved[1, 3] = 2.0
    scaled = pose(3.0, 4.0, depth_scale_sigma=0.005, T_world_camera=moved)
    by_scale = np.diag([0.0, 0.01**2, 0.0, 0.0, 0.0, 0.0])
    found = sigma_of([FIRST, replace(scaled, covariance=scaled.covariance + by_scale, map_covariance=scaled.map_covariance + by_scale)])
    assert found.share == pytest.approx({"noise": 9 / 125, "drift": 16 / 125, "calibration": 0.0, "depth_scale": 100 / 125})
    assert sigma_line(found.to_dict(), RUN).partition("(worst)")[2] == (
        "; mostly the scale of depth: measure a length in the room, and state sigmas.depth_scale in camera.yaml"
    )


def test_degraded_frames_with_few_features_are_counted():
    few, many = (pose(status=DEGRADED, features=count) for count in (49, 50))
    found = sigma_of([FIRST, pose(1.0, 2.0), pose(1.0, 2.0), few, few, many, pose(status=LOST, features=0)])
    assert found.few_features == 2
    assert sigma_line(found.to_dict(), RUN).endswith("map; 2 degraded frames show little of the map: turn slower, or give more light")


def test_without_ok_poses_there_is_no_sigma():
    assert sigma_of([]) is None
    assert sigma_of([FIRST, pose(status=DEGRADED), pose(status=LOST), pose(submap=1)]) is None


@pytest.mark.parametrize("share", [None, {}, {"noise": None}, {"other": 1.0}])
def test_shares_of_a_stranger_have_no_cause(share):
    assert dominant_cause({"share": share}) == ""


@pytest.mark.parametrize(
    ("data", "exact"), [(("synthetic", "dataset."), True), (("faults", "+dataset.options."), False)], ids=["exact camera", "nominal camera"]
)
def test_a_run_says_it_beside_its_statuses(tmp_path, capsys, data, exact):
    """On the console, in metrics.json and in the report."""
    out, (kind, option) = tmp_path / "run", data
    assert main(["run", f"dataset={kind}", f"{option}length=12", f"{option}width=320", f"{option}height=240", f"out={out}"]) == 0
    lines, sigma = capsys.readouterr().out.splitlines(), json.loads((out / "metrics.json").read_text())["sigma"]
    assert lines[0] == "frames: 12 ok" and lines[1] == sigma_line(sigma, out)
    assert sigma["poses"] == 11 and sum(sigma["share"].values()) == pytest.approx(1.0)
    assert sigma["share"]["calibration"] == 0.0 if exact else sigma["share"]["calibration"] > 0.01
    assert 0.0 < sigma["median_m"] <= sigma["worst_m"] < 0.02 and 0.0 < sigma["median_deg"] <= sigma["worst_deg"] < 1.0
    assert main(["report", str(out), "--out", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    table = page.partition("<h2>Stated uncertainty of ok poses</h2>")[2].partition("</table>")[0]
    assert f"<td>{1e3 * sigma['median_m']:.2f}</td>" in table and f">{CAUSES[dominant_cause(sigma)]}</td>" in table
