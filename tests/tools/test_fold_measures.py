"""Errors of surfaces and buildings in ablations: those of the functions that judge whole runs."""

import json
from pathlib import Path

import pytest

from trihedron.comparison import fold_measures
from trihedron.comparison.building_errors import plan_errors_of_run
from trihedron.comparison.fold_measures import COLUMNS, of_folds, of_surface, of_surface_figures
from trihedron.pipeline.app.cli import main
from trihedron.tools.evaluate_surface import SURFACE

SEEDS = Path(__file__).parents[1] / "fuzz" / "seeds"


def test_a_surface_is_off_and_misses_a_share():
    whole = {"mean_m": 0.006, "within_5_cm": 0.98}
    assert of_surface_figures({"parts": {"all": whole}}) == pytest.approx({"surface mm": 6.0, "missed surface %": 2.0})
    assert of_surface_figures({"parts": {"all": {**whole, "mean_m": None}}}) == pytest.approx({"missed surface %": 2.0})


def test_what_was_not_made_or_has_no_truth_has_no_figures(tmp_path, capsys):
    assert of_surface(tmp_path) == {} and of_folds(["surface", "manhattan"], [tmp_path], SEEDS / "own.mcap") == [{}]
    assert capsys.readouterr().err == ""
    (tmp_path / "run.mcap").symlink_to(SEEDS / "own.mcap")
    assert of_folds(["building"], [tmp_path], SEEDS / "own.mcap") == [{}]
    assert capsys.readouterr().err.startswith(f"building of {tmp_path} is not judged: {SEEDS / 'trajectory.txt'}: 0 of its poses have a truth")


def test_equal_surfaces_are_judged_once(tmp_path, monkeypatch):
    judged = []
    figures = {"parts": {"all": {"mean_m": 0.006, "within_5_cm": 0.98}}}
    monkeypatch.setattr(fold_measures, "evaluate_files", lambda surface, source: judged.append(surface.read_text()) or figures)
    runs = [tmp_path / name for name in "abc"]
    for run, content in zip(runs, ["one", "other", "one"]):
        run.mkdir()
        (run / SURFACE).write_text(content)
    assert of_folds(["surface"], runs, SEEDS / "own.mcap") == [of_surface_figures(figures)] * 3
    assert judged == ["one", "other"] and all(of_surface(run) == of_surface_figures(figures) for run in runs)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_alternatives_have_the_figures_of_full_runs(tmp_path, capsys):
    words = ["dataset.scene=flat", "dataset.length=30", "dataset.fps=5", "dataset.width=160", "dataset.height=120", "threads=1"]
    assert main(["run", *words, "outputs=[trajectory,surface,building]", f"out={tmp_path}/run"]) == 0
    swaps = ["surface=planar_polygon", "feedback=recorded", f"out={tmp_path}/out", f"--json={tmp_path}/found.json"]
    assert main(["ablate", f"{tmp_path}/run", "building.least_room_m2=100", *swaps]) == 0
    variants = json.loads((tmp_path / "found.json").read_text())["recordings"][0]["variants"]
    found = {name: value for name, value in variants[0]["figures"].items() if name in COLUMNS}
    assert main(["evaluate-surface", f"{tmp_path}/run"]) == 0
    assert of_surface(tmp_path / "run").items() <= found.items()
    assert found["walls mm"] == pytest.approx(1e3 * plan_errors_of_run(tmp_path / "run")["wall_m"])
    building, surface = (one["figures"] for one in variants[1:])
    assert surface["surface mm"] != found["surface mm"] > 0.0 and building["surface mm"] == found["surface mm"]
    assert building["missed rooms %"] == 100.0 > found["missed rooms %"] == surface["missed rooms %"]
