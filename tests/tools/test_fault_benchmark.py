"""The table of degenerate cases: every case is a valid configuration, and the rows count what the runs hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from trihedron.datasets.faults.faults import Faults
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.registry import load_plugins
from trihedron.pipeline.core.types import Pose, Trajectory
from trihedron.pipeline.run.status_check import check_status
from trihedron.tools.benchmarks.fault_benchmark import CASES, fault_cases, words_of
from trihedron.tools.benchmarks.judged_runs import HEADER, JudgedCase, cells_of, rows_of


@pytest.mark.parametrize("case", list(CASES))
def test_every_case_is_a_data_set_of_enough_frames(case: str) -> None:
    load_plugins()
    parser = OverridesParser.create()
    given = {o.key_or_group: o.value() for o in map(parser.parse_override, words_of(case)) if o.key_or_group.startswith("dataset.")}
    own = {k.removeprefix("dataset."): str(v) if isinstance(v, str) else v for k, v in given.items() if k.count(".") == 1}
    nested = {part: {k.split(".")[2]: v for k, v in given.items() if k.startswith(f"dataset.{part}.")} for part in ("options", "joined")}
    if "frozen" in own:
        own["frozen"] = type(Faults().frozen)[str(own["frozen"])]
    if "covered" in own:
        own["covered"] = type(Faults().covered)[str(own["covered"])]
    if "cover_with" in own:
        own["cover_with"] = type(Faults().cover_with)[str(own["cover_with"])]
    faults = Faults(**own, options={**nested["options"], "width": 64, "height": 48}, joined=nested["joined"])
    assert 60 <= len(faults) <= 135
    truth = faults.truth()
    assert truth is not None and len(truth) >= len(faults)


def test_a_row_counts_wrong_frames() -> None:
    truth = np.array([exp_se3(np.array([np.cos(t), t, 0.2 * t, 0.0, t, 0.1])) for t in np.linspace(0.0, 3.0, 40)])
    stamps = np.arange(40, dtype=np.int64) * 33_333_333
    rng = np.random.default_rng(0)
    estimates = [truth[i] @ exp_se3(0.002 * rng.standard_normal(6)) for i in range(40)]
    poses = [Pose(i, int(stamps[i]), estimates[i], 4e-6 * np.eye(6), np.eye(4), -1, np.array([9, 0, 0], np.int32), 0, "ok", "", 0) for i in range(40)]
    poses[20] = replace(poses[20], T_world_camera=truth[20] @ exp_se3(np.array([0.2, 0, 0, 0, 0, 0])))
    (case,) = fault_cases("frozen", ())
    (found,) = rows_of([JudgedCase(case, *check_status(poses, Trajectory(stamps, truth), 41))])
    row = dict(zip(HEADER, cells_of(found), strict=True))
    assert (row["name"], row["frames"], row["ok %"], row["lost %"], row["wrong ok"]) == ("frozen", "41", "97.6", "0.0", "1")


def test_misspelt_cases_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "faults", "--cases", "frozen_dept"]) == 2
    assert "there is no 'frozen_dept'" in capsys.readouterr().err
    assert main(["benchmark", "faults", "black"]) == 2
    assert capsys.readouterr().err == "trihedron: benchmark faults: 'black' is not key=value; see trihedron benchmark faults --help\n"


@pytest.mark.slow
def test_one_case_is_run_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["+dataset.options.width=160", "+dataset.options.height=120", "dataset.frames=20:50"]
    words = ["benchmark", "faults", "--cases", "black_color", "--runs", str(tmp_path), *small]
    assert main(words) == 0
    first = capsys.readouterr().out
    assert "black_color" in first and (tmp_path / "black_color" / "run.mcap").exists()
    assert main(words) == 0
    assert capsys.readouterr().out == first
