"""The runs of a sweep as one table, and the graphs and omissions it is made for."""

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_module

import trihedron.conf
from trihedron.comparison import other_programs
from trihedron.comparison.run_samples import COLUMNS
from trihedron.comparison.run_tables import WRITERS, as_latex, as_markdown, as_text
from trihedron.comparison.runs import read_runs, rows_of, verdicts_against
from trihedron.comparison.verdicts import line_of
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.config import graph_of, register_configs
from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.geometry import pose_matrix
from trihedron.pipeline.core.registry import load_plugins
from trihedron.pipeline.core.types import Trajectory
from trihedron.pipeline.record.trajectories import write_trajectory

GRAPHS = Path(trihedron.conf.__file__).parent / "graph"
SMALL = ["dataset.width=160", "dataset.height=120", "dataset.length=4"]


def write_run(folder, overrides, ate_m=None, p50=10.0, share=1.0):
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text("".join(f"- {text}\n" for text in overrides))
    if ate_m is not None:
        final = {"ate_rmse_m": ate_m, "tracked_share": share, "rpe_second_rmse_m": 0.002, "rpe_second_rmse_deg": 0.05}
        (folder / "metrics.json").write_text(json.dumps({"final": final}))
        (folder / "timing.json").write_text(json.dumps({"frame_ms": {"p50": p50}}))


def test_rows_say_what_differs_and_seeds_share_one(tmp_path):
    for i, (without, seed, ate) in enumerate([("nothing", 0, 0.002), ("nothing", 1, 0.004), ("lines", 0, 0.006), ("lines", 1, 0.006)]):
        write_run(tmp_path / str(i), [f"without={without}", f"dataset.seed={seed}", "threads=2", f"out={tmp_path}"], ate, p50=10.0 + i)
    assert as_text(rows_of(read_runs(tmp_path))).splitlines() == [
        "change           runs   tracked %      ATE mm  RPE 1 s mm   RPE 1 s deg     p50 ms  ATE mm mean, 95 %",
        "without=nothing     2  100.0 ±0.0  3.00 ±1.00  2.00 ±0.00  0.050 ±0.000  10.5 ±0.5        3.00 ±12.71",
        "without=lines       2  100.0 ±0.0  6.00 ±0.00  2.00 ±0.00  0.050 ±0.000  12.5 ±0.5         6.00 ±0.00",
    ]


def test_data_sets_stand_together_and_a_failed_run_says_why(tmp_path):
    write_run(tmp_path / "a" / "0", ["dataset=tum", "dataset.path=/far/away/desk", "keypoints=orb"], 0.01)
    write_run(tmp_path / "a" / "1", ["dataset=tum", "dataset.path=/far/away/desk", "keypoints=none"], 0.001)
    (tmp_path / "a" / "1" / "job.json").write_text(json.dumps({"state": "failed", "error": "tum: no such folder"}))
    write_run(tmp_path / "b" / "0", ["dataset=tum", "dataset.path=/far/away/door", "keypoints=orb"], 0.02)
    lines = as_text(rows_of(read_runs(tmp_path / "a") + read_runs(tmp_path / "b"))).splitlines()
    assert [line.split()[:3] for line in lines[1:]] == [
        ["dataset.path=desk", "keypoints=orb", "1"],
        ["dataset.path=desk", "keypoints=none", "1"],
        ["dataset.path=door", "keypoints=orb", "1"],
    ]
    assert lines[2].split()[3:] == ["-"] * 5 + ["tum:", "no", "such", "folder"]


def written(tmp_path):
    """Two seeds of two graphs; the baseline is 1 and 3 mm worse."""
    runs = [("structural", 0, 2, 1), ("structural", 1, 4, 1), ("points", 0, 3, 1), ("points", 1, 7, 1), ("direct", 0, 1, 0.3)]
    for i, (graph, seed, ate, share) in enumerate(runs):
        write_run(tmp_path / str(i), [f"graph={graph}", f"seed={seed}"], 1e-3 * ate, share=share)
    return read_runs(tmp_path)


def test_differences_are_paired_and_have_an_interval(tmp_path):
    rows = rows_of(written(tmp_path), baseline="graph=points")
    found = rows[0]["difference"]["ATE mm"]
    half = 12.706 * np.sqrt(2.0) / np.sqrt(2.0)  # Student's t for one degree of freedom; differences -1 and -3
    assert found["mean"] == pytest.approx(-2.0) and found["pairs"] == 2
    assert (found["low"], found["high"]) == (pytest.approx(-2.0 - half, abs=1e-3), pytest.approx(-2.0 + half, abs=1e-3))
    assert rows[1]["difference"] == {} and rows[2]["difference"]["ATE mm"]["low"] is None
    with pytest.raises(UsageError, match="did you mean 'graph=points'"):
        rows_of(written(tmp_path / "again"), baseline="graph=point")


def test_verdicts_of_runs_are_paired_and_first(tmp_path, capsys):
    for i, (graph, seed, ate) in enumerate([("points", s, 4.0) for s in range(4)] + [("structural", s, 2.0 + 0.1 * s) for s in range(4)]):
        write_run(tmp_path / str(i), [f"graph={graph}", f"seed={seed}"], 1e-3 * ate, p50=10.0 + seed)
    assert main(["compare", str(tmp_path), "--baseline", "graph=points"]) == 0
    said = capsys.readouterr().out
    verdicts, _, table = said.partition("\n\n")
    assert verdicts.splitlines()[:3] == [
        "Verdicts",
        "graph=points against structural: tracked 100.0 -> 100.0 %, 0.0 (95 %: 0.0 to 0.0): equal",
        "graph=points against structural: ATE 4.00 -> 2.15 mm, -1.85 (95 %: -2.06 to -1.64), d -14.3: better",
    ]
    assert table.startswith("change ")
    assert main(["compare", str(tmp_path)]) == 0
    assert "Verdicts" not in capsys.readouterr().out


def test_files_hold_the_verdicts(tmp_path):
    """In the row of the change, or of all data where there are several data sets."""
    for i, (graph, seed) in enumerate([("points", 0), ("points", 1), ("structural", 0), ("structural", 1)]):
        write_run(tmp_path / "runs" / str(i), [f"graph={graph}", f"seed={seed}"], 1e-3 * (4.0 if graph == "points" else 2.0 + 0.01 * seed))
    files = {name: tmp_path / f"table.{name}" for name in WRITERS}
    words = ["compare", str(tmp_path / "runs"), "--baseline", "graph=points", *(word for n, file in files.items() for word in (f"--{n}", str(file)))]
    assert main(words) == 0
    line = "graph=points against structural: ATE 4.00 -> 2.00 mm, -2.00 (95 %: -2.06 to -1.93), d -282.1: better"
    base, other = json.loads(files["json"].read_text())
    assert base["verdicts"] == {} and other["verdicts"]["ATE mm"]["text"] == line and other["verdicts"]["ATE mm"]["answer"] == "better"
    assert f"- {line}\n" in files["markdown"].read_text().partition("\n\n")[0] + "\n"
    header, first, second = csv.reader(io.StringIO(files["csv"].read_text()))
    assert [dict(zip(header, row))["ATE mm verdict"] for row in (first, second)] == ["", "better"]
    for i, graph in enumerate(("points", "structural"), 4):
        write_run(tmp_path / "runs" / str(i), [f"graph={graph}", "seed=0", "dataset.scene=corridor"], 0.004)
    assert main(words) == 0
    assert [row["data"] for row in json.loads(files["json"].read_text()) if row["verdicts"]] == ["all"]


def lines_against(folder):
    return [line_of(one, COLUMNS[one.figure]) for one in verdicts_against(read_runs(folder), "graph=points")]


def test_two_runs_are_compared_by_the_errors_of_their_frames(tmp_path, monkeypatch):
    rng, stamps = np.random.default_rng(0), np.arange(300, dtype=np.int64) * 33_333_333
    truth = Trajectory(stamps, np.array([pose_matrix(np.eye(3), position) for position in np.cumsum(rng.normal(size=(300, 3)), axis=0)]))
    monkeypatch.setattr(other_programs, "references", lambda folders: [other_programs.Reference(folders[0][0], {}, stamps, truth, 30.0)])
    for name, sigma_m in (("points", 0.002), ("structural", 0.004)):
        write_run(tmp_path / name, [f"graph={name}"], 1.0)
        poses = truth.poses.copy()
        poses[:, :3, 3] += rng.normal(0.0, sigma_m, (300, 3))
        write_trajectory(tmp_path / name / "trajectory.txt", Trajectory(stamps, poses))
    lines = lines_against(tmp_path)
    assert [line.partition(": ")[2].split()[0] for line in lines] == ["ATE", "RPE", "RPE"]
    assert lines[0].startswith("graph=points against structural: ATE 3.50 -> 6.88 mm, +3.39 (95 %: ") and lines[0].endswith(": worse")
    (tmp_path / "points" / "trajectory.txt").unlink()
    assert lines_against(tmp_path)[0].endswith("ATE 1000.00 -> 1000.00 mm, 0.00: one recording, no interval")


def test_the_best_is_bold_and_an_error_over_few_frames_is_not(tmp_path):
    rows = rows_of(written(tmp_path))
    assert as_markdown(rows).splitlines()[2].split(" | ")[2:4] == ["**100.0 ±0.0**", "3.00 ±1.00"]  # the other's best run is better than its worst
    rows[1]["figures"]["ATE mm"]["min"] = 4.5
    assert as_markdown(rows).splitlines()[2].split(" | ")[2:4] == ["**100.0 ±0.0**", "**3.00 ±1.00**"]
    assert "| 30.0 | 1.00 |" in as_markdown(rows).splitlines()[4]
    assert r"graph=structural & 2 & \textbf{100.0 $\pm$0.0} & \textbf{3.00 $\pm$1.00}" in as_latex(rows)
    assert "\033[1m3.00 ±1.00\033[0m" in as_text(rows, bold=True) and "\033" not in as_text(rows, bold=False)


def test_files_hold_the_figures(tmp_path):
    written(tmp_path / "runs")
    files = {name: tmp_path / f"table.{name}" for name in WRITERS}
    assert main(["compare", str(tmp_path / "runs"), *(word for name, file in files.items() for word in (f"--{name}", str(file)))]) == 0
    figure = json.loads(files["json"].read_text())[0]["figures"]["ATE mm"]
    assert figure == {"median": 3.0, "min": 2.0, "max": 4.0, "runs": 2, "mean": 3.0, "half": pytest.approx(12.7062, rel=1e-5)}
    table = list(csv.DictReader(files["csv"].open()))
    assert [(row["change"], row["ATE mm median"]) for row in table] == [("graph=structural", "3.0"), ("graph=points", "5.0"), ("graph=direct", "1.0")]


@pytest.mark.slow
def test_a_sweep_ends_with_the_table(tmp_path, capsys):
    sweep = ["run", "-m", "experiment=leave_one_out", "without=nothing,planes", *SMALL, f"out={tmp_path / 'sweep'}"]
    assert main(sweep) == 0
    said = capsys.readouterr().out
    assert said.startswith("change ") and "\nwithout=nothing " in said and "\nwithout=planes " in said


@pytest.mark.slow
def test_every_system_computed_again_has_the_same_figures(tmp_path):
    """The table of all graphs twice from nothing, the second time with other threads: equal figures, and the same bytes of each surface."""
    words = ["run", "-m", "experiment=paper", 'sequences=["synthetic length=12 width=320 height=240"]']
    found = []
    for folder, threads in (("once", "threads=1"), ("again", "threads=2")):
        assert main([*words, threads, f"out={tmp_path / folder}"]) == 0
        runs = {run.overrides["graph"]: run.folder for run in read_runs(tmp_path / folder)}
        metrics = {graph: json.loads((run / "metrics.json").read_text()) for graph, run in runs.items()}
        found.append({graph: (metrics[graph], (run / "surface.ply").read_bytes()) for graph, run in runs.items()})
    print("\n".join(f"{graph}: {1e3 * metrics['final']['ate_rmse_m']:.3f} mm" for graph, (metrics, _) in found[0].items()))
    assert [graph for graph in found[0] if found[0][graph] != found[1][graph]] == []
    assert len(found[0]) == len(found[1]) == len(list(GRAPHS.glob("*.yaml")))
    assert all(np.isfinite(metrics["final"]["ate_rmse_m"]) for metrics, _ in found[0].values())


def test_a_folder_without_runs(tmp_path, capsys):
    assert main(["compare", str(tmp_path)]) == 1
    cure = "give the out=FOLDER of a sweep, for example of: trihedron run -m experiment=leave_one_out"
    assert capsys.readouterr().err == f"trihedron: {tmp_path}: holds no runs; {cure}\n"


def test_a_folder_that_does_not_exist(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for word, place in (("runs/nope", f"does not exist in {tmp_path}"), (f"{tmp_path}/nope", "does not exist")):
        assert main(["compare", word]) == 1
        assert capsys.readouterr().err == f"trihedron: {word}: {place}; give the out=FOLDER of a run or of a sweep\n"


def test_a_trajectory_without_a_run_to_compare_it_with(tmp_path, capsys):
    (tmp_path / "orbslam2.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert main(["compare", str(tmp_path / "orbslam2.txt")]) == 2
    cure = "give the folder of a run of the same data set before them"
    assert capsys.readouterr().err == f"trihedron: compare: there are trajectories and no run; {cure}\n"


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
