"""The error budget on runs whose budget is known."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from trihedron.comparison.error_budget import Rerun, remarks
from trihedron.pipeline.app.cli import main

sys.path.insert(0, str(Path(__file__).parent))
from faulty_plugins import faulty

__all__ = ["faulty"]  # a fixture

ROOM = ["dataset.length=14", "dataset.width=320", "dataset.height=240", "threads=1"]


def budget(path, capsys):
    """Row -> ATE."""
    capsys.readouterr()
    assert main(["error-budget", str(path)]) == 0
    rows = [line.rsplit(maxsplit=4) for line in capsys.readouterr().out.strip().splitlines()[1:] if not line.endswith(".")]
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


def reruns(**errors):
    """The whole run and rows, by the names of their stages, with these errors (n,) of frames, in metres."""
    every = {(): errors.pop("whole"), **{tuple(name.split("_and_")): values for name, values in errors.items()}}
    return {
        stages: Rerun(
            {"ate_rmse_m": float(np.sqrt(np.nanmean(values**2))), "rpe_second_frames": 30, "poses_with_truth": int(np.isfinite(values).sum())},
            {"ate_rmse_m": values},
        )
        for stages, values in every.items()
    }


def test_rows_within_the_noise_are_named_below_the_table():
    rng = np.random.default_rng(0)
    whole, other = rng.uniform(0.5e-2, 1.5e-2, (2, 600))
    assert remarks(reruns(whole=whole, map=0.5 * whole)) == []
    assert remarks(reruns(whole=whole, rotation=other, map=0.5 * whole, rotation_and_map=whole)) == [
        "These rows differ from the whole run by no more than its noise over 600 poses: rotation, rotation + map."
    ]
    assert remarks(reruns(whole=whole, rotation=other)) == ["No row differs from the whole run by more than its noise over 600 poses."]


def test_too_few_poses_are_stated_below_the_table():
    whole = np.random.default_rng(0).uniform(0.5e-2, 1.5e-2, 60)
    assert remarks(reruns(whole=whole, rotation=0.5 * whole, map=0.9 * whole)) == ["60 poses are too few to tell any row from the whole run."]


def test_rows_that_track_fewer_poses_are_named_below_the_table():
    whole = np.random.default_rng(0).uniform(0.5e-2, 1.5e-2, 600)
    lost = np.where(np.arange(600) < 400, 0.5 * whole, np.nan)
    assert remarks(reruns(whole=whole, map=lost)) == [
        "These rows track fewer than the whole run's 600 poses, so that their errors are not comparable: map."
    ]


@pytest.mark.slow
def test_a_wrong_sign_in_translation_disappears_with_the_true_translation(tmp_path, capsys, faulty):
    words = ["graph=structural_no_refine", "translation=wrong_sign", *ROOM]
    assert main(["run", *words, f"out={tmp_path}/run"]) == 0
    found = budget(tmp_path / "run" / "run.mcap", capsys)
    assert found["translation"] < 0.2 * found["nothing"] and found["rotation"] > 0.5 * found["nothing"]
    assert min(("rotation", "translation"), key=found.get) == "translation"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_noise_of_planes_is_attributed_to_planes(tmp_path, faulty):
    assert main(["run", "graph=structural_no_refine", "dataset.texture=false", *ROOM, f"out={tmp_path}/run"]) == 0
    words = ["planes=noisy", "manhattan=plane_svd", "translation.motion_sigma_m=0.2"]
    command = ["ablate", f"{tmp_path}/run/run.mcap", *words, f"out={tmp_path}/ablation", "threads=1", f"--json={tmp_path}/found.json"]
    assert main(command) == 0
    attribution = json.loads((tmp_path / "found.json").read_text())["attribution"]
    shares = {one["stage"]: abs(one["mean"]) for one in attribution if one["figure"] == "RPE 1 frame mm" and one["stage"]}
    assert set(shares) == {"planes", "manhattan", "translation"} and max(shares, key=shares.get) == "planes"
