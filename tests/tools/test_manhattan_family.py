"""`trihedron manhattan-family`: estimators on rendered rooms with known axes, and on a sweep over one recording."""

import json

import numpy as np
import pytest

from trihedron.pipeline.cli import main
from trihedron.pipeline.geometry import exp_so3
from trihedron.pipeline.recording import Recording
from trihedron.pipeline.registry import load_plugins, plugins_of
from trihedron.pipeline.types import ManhattanFrame
from trihedron.plugins.numerics.cube_symmetry import CUBE
from trihedron.tools.manhattan_family import SHEAR, error_deg, measure
from trihedron.tools.rotation_comparison import rotation_errors


def frame(R):
    return ManhattanFrame(0, 0, R[None], np.zeros(1, np.int32), np.eye(3)[None], np.zeros((1, 3), np.int32), np.zeros((1, 3)), True)


def test_the_error_knows_no_names_of_axes():
    truth = exp_so3(np.array([0.3, -1.2, 0.4]))
    for S in CUBE:
        assert error_deg(frame(exp_so3(np.radians([0.0, 2.0, 0.0])) @ truth @ S), truth) == pytest.approx(2.0, abs=1e-6)
    assert error_deg(None, truth) == 180.0


def test_no_two_walls_of_the_oblique_room_are_at_right_angles():
    normals = np.linalg.inv(SHEAR)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angles = np.degrees(np.arccos((normals @ normals.T)[np.triu_indices(3, 1)]))
    assert (abs(angles - 90.0) > 8.0).all()


def test_few_views_and_one_estimator(tmp_path, capsys):
    assert main(["manhattan-family", "--orientations", "6", "--estimators", "mean_shift", "--json", str(tmp_path / "f.json")]) == 0
    assert "50% clutter" in capsys.readouterr().out
    rows = {row["condition"]: row for row in json.loads((tmp_path / "f.json").read_text())}
    assert rows["clean"]["views"] > 0 and rows["clean"]["near"]["within"] == 1.0 and rows["clean"]["none"]["claimed"] == 1.0
    assert main(["manhattan-family", "--estimators", "mean_shit"]) == 1 + 1
    assert "mean_shift" in capsys.readouterr().err


@pytest.mark.slow
def test_estimators_where_two_axes_are_visible():
    load_plugins()
    names = [name for name in ("mean_shift", "branch_and_bound") if name in plugins_of("manhattan")]
    rows = {row["estimator"]: row for row in measure(names, 150, ("clean",))}
    assert rows["mean_shift"]["views"] >= 75
    assert rows["mean_shift"]["near"]["within"] >= 0.99
    if "branch_and_bound" in rows:
        assert rows["branch_and_bound"]["none"]["within"] >= 0.99


@pytest.mark.slow
def test_one_command_replays_every_estimator(tmp_path, capsys):
    small = ["dataset=synthetic", "dataset.width=160", "dataset.height=120", "dataset.length=6"]
    assert main(["run", *small, f"out={tmp_path}/run"]) == 0
    assert main(["run", "-m", "experiment=rotation_family", f"replay={tmp_path}/run/run.mcap", f"out={tmp_path}/sweep"]) == 0
    assert len(list((tmp_path / "sweep").glob("*/run.mcap"))) >= 6
    errors = rotation_errors(Recording(tmp_path / "sweep" / "0" / "run.mcap"))
    assert errors[:, 0].tolist() == list(range(6)) and np.nanmax(errors[:, 1]) < 2.0
    assert main(["manhattan-family", "--runs", f"{tmp_path}/sweep", "--out", f"{tmp_path}/pictures", "--sphere", "3"]) == 0
    assert "branch_and_bound" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {"rotation_error.png", "sphere_3.png"}
