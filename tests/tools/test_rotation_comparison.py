"""Estimators of the Manhattan frame over one recording, as `trihedron ablate` computes them: a table and pictures."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from trihedron.comparison.axes import common_world, read_runs, residuals_deg
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core import registry
from trihedron.pipeline.core.lie import exp_so3
from trihedron.pipeline.core.types import ManhattanFrame, Normals
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE

SMALL = ["dataset=synthetic", "dataset.width=160", "dataset.height=120", "dataset.length=5", "outputs=[manhattan]"]


def saying(normals, R, supported=True):
    return ManhattanFrame(
        normals.index, normals.stamp_ns, R[None], np.zeros(1, np.int32), np.eye(3)[None], np.ones((1, 3), np.int32), np.zeros((1, 3)), supported
    )


@pytest.fixture
def foreign():
    """A plugin of another package: claims every second frame, always the same rotation."""

    @registry.register("manhattan", "stubborn")
    @dataclass(frozen=True)
    class Stubborn:
        """Always says the same."""

        def __call__(self, normals: Normals) -> ManhattanFrame:
            return saying(normals, exp_so3(np.array([0.4, 0.3, -0.3])), normals.index % 2 == 0)

    yield
    registry._PLUGINS["manhattan"].pop("stubborn")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    assert main(["run", *SMALL, "record.topics=[normals]", f"out={folder}"]) == 0
    return folder / "run.mcap"


def test_a_plugin_of_another_package_joins_by_a_word(recording, foreign, tmp_path, capsys):
    assert main(["ablate", str(recording), "manhattan=mean_shift,plane_svd,stubborn", "feedback=recorded", f"out={tmp_path}"]) == 0
    assert {path.name for path in tmp_path.glob("*.png")} == {"rotation_error.png", "sphere_2.png"}
    capsys.readouterr()
    assert main(["benchmark", "rotations", str(tmp_path), "--frame", "4"]) == 0 and (tmp_path / "sphere_4.png").stat().st_size > 20_000
    said = capsys.readouterr().out
    rows = {line.split()[0]: line.split()[1:] for line in said.splitlines() if line.startswith(("mean_shift ", "plane_svd ", "stubborn "))}
    assert rows["mean_shift"][:4] == ["5", "1.000", "1.000", "0.000"] and float(rows["mean_shift"][4]) < 0.5
    assert rows["stubborn"][:4] == ["5", "0.600", "0.000", "0.600"] and float(rows["stubborn"][4]) > 10.0
    assert main(["benchmark", "rotations", str(tmp_path), "--frame", "9"]) == 1
    assert "give one of 0..4" in capsys.readouterr().err
    runs = {run.name: run for run in read_runs(tmp_path, list(tmp_path.iterdir()))}
    world = common_world(list(runs.values()))
    assert residuals_deg(world[None], np.eye(3))[0] < 0.6  # the room's axes are the world's
    assert 0.02 < runs["mean_shift"].nees(world) < 4.7 and np.isnan(runs["stubborn"].nees(world))
    errors = runs["stubborn"].errors_deg(world)
    assert np.isnan(errors[1::2]).all() and (errors[::2] > 10.0).all()


def test_a_folder_without_runs_is_an_error(tmp_path, capsys):
    assert main(["benchmark", "rotations", str(tmp_path)]) == 1
    assert "trihedron ablate RUN.mcap 'manhattan=*' feedback=recorded" in capsys.readouterr().err


def test_residuals_know_no_names_of_axes():
    R = exp_so3(np.array([0.2, 0.5, -0.1]))
    turned = np.array([exp_so3(np.radians([0.0, 0.0, angle])) @ R @ CUBE[k] for k, angle in enumerate((0.0, 2.0, 30.0))])
    assert np.allclose(residuals_deg(turned, R), [0.0, 2.0, 30.0], atol=1e-5)


def test_each_of_several_recordings_has_its_pictures_once(tmp_path, capsys):
    """In a corridor, whose walk a configuration of plain words cannot name."""
    words = ["dataset.scene=corridor", "dataset.texture=false", "dataset.length=4", "dataset.width=160", "dataset.height=120"]
    assert main(["run", *words, "outputs=[manhattan]", f"out={tmp_path}/run"]) == 0
    shutil.copytree(tmp_path / "run", tmp_path / "copy")
    command = ["ablate", f"{tmp_path}/run", f"{tmp_path}/copy", "manhattan=plane_svd", "feedback=recorded", f"out={tmp_path}/axes"]
    assert main(command) == 0
    drawn = {path: path.stat().st_mtime_ns for path in (tmp_path / "axes").glob("*.png")}
    assert {path.name for path in drawn} == {f"{name},{kind}.png" for name in ("run", "copy") for kind in ("rotation_error", "sphere_2")}
    capsys.readouterr()
    assert main([*command, "--dry-run"]) == 0 and capsys.readouterr().out.count("\n2  manhattan=plane_svd: done\n") == 2
    assert main(command) == 0 and {path: path.stat().st_mtime_ns for path in drawn} == drawn


def test_without_ground_truth_a_line_says_that_nothing_is_drawn(tmp_path, capsys):
    source = Path(__file__).parents[1] / "fuzz" / "seeds" / "own.mcap"
    assert main(["ablate", str(source), "manhattan=plane_svd", "feedback=recorded", f"out={tmp_path}"]) == 0
    assert "\nno pictures of the axes: " in capsys.readouterr().err and not list(tmp_path.glob("*.png"))


@pytest.mark.slow
def test_every_registered_estimator_takes_part(recording, tmp_path, capsys):
    assert main(["ablate", str(recording), "manhattan=*", "feedback=recorded", f"out={tmp_path}"]) == 0
    assert main(["benchmark", "rotations", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    names = [name for name in registry.plugins_of("manhattan") if name != "none"]
    assert len(names) >= 6 and all(f"\n{name} " in said for name in names)
