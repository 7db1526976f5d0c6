"""`trihedron paper` and `experiment=paper`: the paper's tables over runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.types import Trajectory
from trihedron.pipeline.record.trajectories import TRUTH, format_trajectory, write_trajectory
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.tools import paper

FAR, KT3 = "/data/tum_fr3_structure_notexture_far", "/data/icl_nuim_of_kt3"
STAGES = {"normals": 3.0, "keypoints": 5.0, "lines": 2.0, "segments": 0.5, "planes": 4.0, "manhattan": 0.5, "tracks": 1.0, "rotation": 0.5}


def write_run(folder: Path, graph: str, path: str, ate_m: float, frames: int, *words: str) -> None:
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump([f"graph={graph}", "dataset=tum", f"dataset.path={path}", *words]))
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump({"dataset": {"plugin": "tum", "path": path}}))
    (folder / "metrics.json").write_text(json.dumps({"frames": frames, "final": {"ate_rmse_m": ate_m, "tracked_share": 1.0}}))
    stages = STAGES | {"translation": 1.0, "matches": 0.5, "pose": 2.0}
    (folder / "timing.json").write_text(json.dumps({"frame_ms": {"p50": 21.0}, "stages": {name: {"p50_ms": ms} for name, ms in stages.items()}}))


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    cases = [("structural_paper", FAR, 0.007, 250), ("structural_no_refine", FAR, 0.014, 250), ("structural_paper", KT3, 0.015, 1241)]
    for number, case in enumerate(cases):
        write_run(tmp_path / "runs" / str(number), *case)
    return tmp_path / "runs"


def rows(text: str, title: str) -> dict[str, list[str]]:
    """The rows of a table of Markdown by their first cell."""
    part = text.split(f"## {title}\n")[1].split("\n## ")[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines() if line.startswith("|")]
    return {row[0]: row[1:] for row in cells[2:]}


def test_tables_have_ours_beside_the_published_figures(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert paper.main([str(runs), "--markdown", str(tmp_path / "paper.md")]) == 0
    text = (tmp_path / "paper.md").read_text()
    first = rows(text, "Table I: trajectory error")
    assert len(first) == 12
    assert first["snot-far"] == ["7.00", "14.00", "22", "26", "-", "20", "75", "141", "213", "37", "250 of about 818 frames: not comparable"]
    assert first["of-kt3"] == ["15.00", "-", "14", "12", "65", "12", "30", "11", "79", "10", "whole"]
    assert first["cabinet"][:3] == ["-", "-", "35"] and first["cabinet"][-1] == "trihedron download tum/fr3_cabinet"
    second = rows(text, "Table II: time per stage")
    assert second["structural_paper, icl_nuim_of_kt3"] == ["14.5", "2.0", "1.0", "2.5", "21.0"]
    assert second["paper, TUM RGB-D"] == ["19.9", "2.1", "4.8", "13.0", "42.5"]
    assert rows(text, "Effect of refinement") == {"tum_fr3_structure_notexture_far": ["7.00", "14.00", "2.00", "22", "26"]}
    assert "Surface: error and size" not in text and "Drift" not in text
    assert "trihedron download icl_nuim/lr_kt0" in capsys.readouterr().out


def test_drift_is_that_of_the_end_against_the_start(runs: Path) -> None:
    """Forty metres straight on, five centimetres too far at the end."""
    count = 41
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    stamps = np.arange(count, dtype=np.int64) * 1_000_000_000
    truth = Trajectory(stamps, poses.copy())
    poses[-1, 2, 3] += 0.05
    write_trajectory(runs / "2" / "trajectory.txt", Trajectory(stamps, poses))
    writer = RecordingWriter(runs / "2" / "run.mcap", {"version": "0", "commit": "", "overrides": "[]", "config": ""})
    writer.attach(TRUTH, format_trajectory(truth))
    writer.close()
    [table] = [table for table in paper.tables_of(paper.known_of([runs])) if "rift" in table.title]
    assert table.title == "Other data: drift of long walks"  # the paper has the drift of no such sequence
    assert table.rows == (("structural, icl_nuim_of_kt3", "40.0", "0.0500", "0.125"),)


def test_variants_of_a_graph_have_columns_and_rows_of_their_own(tmp_path: Path) -> None:
    for number, (graph, words) in enumerate([(g, w) for g in ("structural_paper", "structural_no_refine") for w in ((), ("planes=cape",))]):
        write_run(tmp_path / str(number), graph, FAR, 0.007 + 0.001 * number, 818, *words)
    tables = {table.title: table for table in paper.tables_of(paper.known_of([tmp_path]))}
    first = tables["Table I: trajectory error"]
    assert first.header[1:5] == ("structural_paper", "structural_paper planes=cape", "structural_no_refine", "structural_no_refine planes=cape")
    assert [row[1:5] for row in first.rows if row[0] == "snot-far"] == [("7.00", "8.00", "9.00", "10.00")]
    name = "tum_fr3_structure_notexture_far"
    assert [row[0] for row in tables["Table II: time per stage"].rows[:-1]] == [f"default, {name}", f"planes=cape, {name}"]
    assert [row[:4] for row in tables["Effect of refinement"].rows] == [
        (f"default, {name}", "7.00", "9.00", "1.29"),
        (f"planes=cape, {name}", "8.00", "10.00", "1.25"),
    ]


def test_two_runs_of_a_sequence_have_rows_of_their_own(tmp_path: Path) -> None:
    write_run(tmp_path / "0", "structural_paper", FAR, 0.007, 818)
    write_run(tmp_path / "1", "structural_paper", FAR, 0.005, 100, "dataset.frames=0:100")
    [first, *_] = paper.tables_of(paper.known_of([tmp_path]))
    rows = {row[0]: (row[1], row[-1]) for row in first.rows if row[0].startswith("snot-far")}
    name = "snot-far, tum_fr3_structure_notexture_far"
    assert rows == {name: ("7.00", "whole"), f"{name} frames=0:100": ("5.00", "100 of about 818 frames: not comparable")}


def test_other_data_have_tables_of_their_own(runs: Path) -> None:
    write_run(runs / "3", "structural_paper", "/data/desk", 0.011, 90)
    write_run(runs / "4", "structural_no_refine", "/data/desk", 0.022, 90)
    tables = {table.title: table for table in paper.tables_of(paper.known_of([runs]))}
    for title in ("Table I: trajectory error", "Table II: time per stage", "Effect of refinement"):
        assert not any("desk" in row[0] for row in tables[title].rows)
    assert tables["Other data: trajectory error"].header == ("data", "structural_paper", "structural_no_refine", "frames")
    assert tables["Other data: trajectory error"].rows == (("desk", "11.00", "22.00", "90"),)
    assert tables["Other data: time per stage"].rows == (("structural_paper, desk", "14.5", "2.0", "1.0", "2.5", "21.0"),)
    assert tables["Other data: effect of refinement"].rows == (("desk", "11.00", "22.00", "2.00"),)


def test_the_old_name_of_the_experiment_is_accepted_with_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "-m", "experiment=paper_table", "graph=nothing", "out=nowhere"]) == 1
    assert "trihedron: warning: experiment=paper_table is now experiment=paper\n" in capsys.readouterr().err
