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


def write_run(folder: Path, graph: str, path: str, ate_m: float, frames: int) -> None:
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump([f"graph={graph}", "dataset=tum", f"dataset.path={path}"]))
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
    known = paper.known_of([runs])
    table = paper.drift_table(known)
    assert table is not None and table.rows == (("structural, icl_nuim_of_kt3", "40.0", "0.0500", "0.125", "-", "-"),)


def test_the_old_name_of_the_experiment_is_accepted_with_a_warning(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "-m", "experiment=paper_table", "graph=nothing", "out=nowhere"]) == 1
    assert "trihedron: warning: experiment=paper_table is now experiment=paper\n" in capsys.readouterr().err
