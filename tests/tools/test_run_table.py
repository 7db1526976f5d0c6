"""The runs of a sweep as one table, and the graphs and omissions it is made for."""

import json

import pytest
from hydra import compose, initialize_config_module

from trihedron.pipeline.cli import main
from trihedron.pipeline.config import graph_of, register_configs
from trihedron.pipeline.registry import load_plugins
from trihedron.tools.run_table import as_text, read_runs, rows_of

SMALL = ["dataset.width=160", "dataset.height=120", "dataset.length=4"]


def write_run(folder, overrides, ate_m=None, p50=10.0):
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text("".join(f"- {text}\n" for text in overrides))
    if ate_m is not None:
        final = {"ate_rmse_m": ate_m, "tracked_share": 1.0, "rpe_second_rmse_m": 0.002, "rpe_second_rmse_deg": 0.05}
        (folder / "metrics.json").write_text(json.dumps({"final": final}))
        (folder / "timing.json").write_text(json.dumps({"frame_ms": {"p50": p50}}))


def test_rows_say_what_differs_and_seeds_share_one(tmp_path):
    for i, (without, seed, ate) in enumerate([("nothing", 0, 0.002), ("nothing", 1, 0.004), ("lines", 0, 0.006), ("lines", 1, 0.006)]):
        write_run(tmp_path / str(i), [f"without={without}", f"dataset.seed={seed}", "threads=2", f"out={tmp_path}"], ate)
    assert as_text(rows_of(read_runs(tmp_path))).splitlines() == [
        "change           runs   tracked %      ATE mm  RPE 1 s mm   RPE 1 s deg  frame p50 ms  x first",
        "without=nothing     2  100.0 ±0.0  3.00 ±1.00  2.00 ±0.00  0.050 ±0.000     10.0 ±0.0     1.00",
        "without=lines       2  100.0 ±0.0  6.00 ±0.00  2.00 ±0.00  0.050 ±0.000     10.0 ±0.0     2.00",
    ]


def test_data_sets_stand_together_and_a_failed_run_has_no_figures(tmp_path):
    write_run(tmp_path / "a" / "0", ["dataset=tum", "dataset.path=/far/away/desk", "keypoints=orb"], 0.01)
    write_run(tmp_path / "a" / "1", ["dataset=tum", "dataset.path=/far/away/desk", "keypoints=none"])
    write_run(tmp_path / "b" / "0", ["dataset=tum", "dataset.path=/far/away/door", "keypoints=orb"], 0.02)
    lines = as_text(rows_of(read_runs(tmp_path / "a") + read_runs(tmp_path / "b"))).splitlines()
    assert [line.split()[:3] for line in lines[1:]] == [
        ["dataset.path=desk", "keypoints=orb", "1"],
        ["dataset.path=desk", "keypoints=none", "1"],
        ["dataset.path=door", "keypoints=orb", "1"],
    ]
    assert lines[2].split()[3:] == ["-"] * 6
    assert lines[3].split()[-1] == "1.00"


def test_a_sweep_ends_with_the_table(tmp_path, capsys):
    sweep = ["run", "-m", "experiment=leave_one_out", "without=nothing,planes", *SMALL, f"out={tmp_path / 'sweep'}"]
    assert main(sweep) == 0
    said = capsys.readouterr().out
    assert "\nchange " in said and "\nwithout=nothing " in said and "\nwithout=planes " in said


def test_a_folder_without_runs(tmp_path, capsys):
    assert main(["benchmark", "runs", str(tmp_path)]) == 1
    cure = "give the out=FOLDER of a sweep, for example of: trihedron run -m experiment=leave_one_out"
    assert capsys.readouterr().err == f"trihedron: {tmp_path}: holds no runs; {cure}\n"


def composed(*overrides):
    load_plugins()
    register_configs()
    with initialize_config_module("trihedron.conf", version_base="1.3"):
        return graph_of(compose("root", overrides=list(overrides)))


@pytest.mark.parametrize("graph", ["points", "points_lines", "points_planes"])
def test_graphs_without_a_manhattan_frame_do_not_look_for_one(graph):
    stages = composed(f"graph={graph}").stages
    assert "manhattan" not in stages and stages["loop"].plugin.straighten == 0
    assert type(stages["rotation"].plugin).__name__ == "Procrustes"
    kinds = {slot: type(stages[slot].plugin).__name__.startswith("No") for slot in ("keypoints", "lines", "planes") if slot in stages}
    assert kinds == {"keypoints": False, "lines": graph != "points_lines", "planes": graph != "points_planes"}


def test_what_is_left_out_is_not_run():
    assert "manhattan" not in composed("without=manhattan").stages
    assert composed("without=manhattan").stages["loop"].plugin.straighten == 0
    assert composed("without=relations").stages["matches"].plugin.relations == 0
    assert type(composed("without=lines").stages["lines"].plugin).__name__ == "NoLines"
    assert set(composed("without=nothing").stages) == set(composed().stages)
