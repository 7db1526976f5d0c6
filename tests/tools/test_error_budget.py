"""The error budget on runs whose budget is known."""

import json

import pytest

from trihedron.pipeline.app.cli import main

ROOM = ["dataset.length=14", "dataset.width=320", "dataset.height=240", "threads=1"]


def budget(path, capsys):
    """Row -> ATE."""
    capsys.readouterr()
    assert main(["error-budget", str(path)]) == 0
    rows = [line.rsplit(maxsplit=4) for line in capsys.readouterr().out.strip().splitlines()[1:]]
    return {row[0].strip(): float(row[1]) for row in rows}


@pytest.mark.slow
def test_without_refinement_the_true_decoupled_pose_leaves_nothing(tmp_path, capsys):
    assert main(["run", "graph=structural_no_refine", *ROOM, f"out={tmp_path}/run"]) == 0
    found = budget(tmp_path / "run" / "run.mcap", capsys)
    assert next(iter(found)) == "nothing" and found["nothing"] > 0.0
    assert found["rotation + translation"] == 0.0 and found["translation"] < found["nothing"]


@pytest.mark.slow
def test_with_nothing_replaced_the_default_graph_errs_as_it_did(tmp_path, capsys):
    """A map that is computed again is adjusted again; with the corrections of another one errors would be hundredfold."""
    assert main(["run", "dataset.length=30", *ROOM[1:], f"out={tmp_path}/run"]) == 0
    ate = json.loads((tmp_path / "run" / "metrics.json").read_text())["final"]["ate_rmse_m"]
    found = budget(tmp_path / "run" / "run.mcap", capsys)
    assert found["nothing"] == round(ate, 4)
    assert len(found) == 6 and all(error < 2.0 * ate for error in found.values())


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["outputs=[planes]"], "holds no poses with ground truth; record a run of a data set that has it"),
        (None, "cannot be read: No such file or directory; give the path of an MCAP file"),
    ],
)
def test_what_it_cannot_judge(tmp_path, capsys, overrides, message):
    path = tmp_path / "run" / "run.mcap"
    if overrides is not None:
        assert main(["run", "dataset.length=2", *ROOM[1:], *overrides, f"out={path.parent}"]) == 0
    capsys.readouterr()
    assert main(["error-budget", str(path)]) == 1
    assert capsys.readouterr().err == f"trihedron: {path}: {message}\n"
