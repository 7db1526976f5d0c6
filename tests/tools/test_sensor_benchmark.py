"""The tables of the sensor benchmark on known figures, and its command on tiny runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.lie import exp_se3
from trihedron.pipeline.core.types import Pose, Trajectory
from trihedron.pipeline.run.status_check import check_status
from trihedron.tools.benchmarks.judged_runs import Case, JudgedCase, chosen, report
from trihedron.tools.benchmarks.sensor_benchmark import correlations, words_of


def judged(sensor: str, wrong: int) -> JudgedCase:
    truth = np.array([exp_se3(np.array([np.cos(t), t, 0.2 * t, 0.0, t, 0.1])) for t in np.linspace(0.0, 3.0, 40)])
    stamps = np.arange(40, dtype=np.int64) * 33_333_333
    rng = np.random.default_rng(0)
    moved = [exp_se3(np.array([0.2 * (5 <= i < 5 + wrong), 0, 0, 0, 0, 0])) @ exp_se3(0.002 * rng.standard_normal(6)) for i in range(40)]
    poses = [
        Pose(i, int(stamps[i]), truth[i] @ moved[i], 4e-6 * np.eye(6), np.eye(4), -1, np.array([9, 0, 0], np.int32), 0, "ok", "", 0)
        for i in range(40)
    ]
    return JudgedCase(Case(sensor, [], {"sensor": sensor, "room": "room"}), *check_status(poses, Trajectory(stamps, truth)))


def test_the_rows_of_all_runs_sum_the_wrong_frames() -> None:
    lines = report([judged("tof", 2), judged("phone", 3)]).splitlines()
    assert [line.split()[:2] for line in lines[1:]] == [["sensor", "tof"], ["sensor", "phone"], ["room", "room"], ["all", "clean"]]
    assert [line[: lines[0].index("wrong ok") + len("wrong ok")].split()[-1] for line in lines[1:]] == ["2", "3", "5", "5"]


def test_figures_that_rank_runs_as_their_errors_do_correlate() -> None:
    def row(ate: float | None, **quality: Any) -> tuple[dict[str, Any], float | None]:
        return quality, ate

    found = [row(ate, frames=60, grows=ate**3, falls=-ate, same=1.0, gone=None) for ate in (0.1, 0.4, 0.2, 0.3)] + [row(None, grows=9.0)]
    rows = {line.split()[0]: line.split()[1:] for line in correlations(found).splitlines()[1:]}
    assert rows == {"grows": ["+1.00", "4"], "falls": ["-1.00", "4"], "same": ["-", "4"], "gone": ["-", "0"]}


def test_a_case_is_the_sensor_in_the_room() -> None:
    words = words_of("phone", "bare", 3, 50)
    assert words[0] == "dataset=simulated_sensor" and {"dataset.sensor_seed=3", "dataset.texture=false", "dataset.length=50"} <= set(words)
    assert chosen("a,b", "abc") == ["a", "b"]


def test_unknown_sensors_and_ranges_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "sensors", "--sensors", "kinect"]) == 2
    assert "there is no 'kinect'" in capsys.readouterr().err
    assert main(["benchmark", "sensors", "--seeds", "0"]) == 2
    assert "--seeds, --first-seed or --length is out of range" in capsys.readouterr().err


@pytest.mark.slow
def test_a_sensor_is_judged_by_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--sensors", "tof", "--rooms", "room", "--seeds", "1", "--length", "12", "dataset.width=160", "dataset.height=120"]
    assert main(["benchmark", "sensors", *words, "--runs", str(tmp_path), "--json", str(tmp_path / "a.json")]) == 0
    assert "tof" in capsys.readouterr().out
    (figures,) = json.loads((tmp_path / "a.json").read_text())
    assert figures["frames"] == 12 and figures["seed"] == 0 and figures["hidden"]["readout_ms"] >= 15.0
