"""The table of honesty: means and intervals over runs, false alarms by the test, and runs that are kept."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.types import Trajectory
from trihedron.pipeline.run.status_check import StatusCheck, check_status
from trihedron.tools import benchmark
from trihedron.tools.benchmarks import judged_runs
from trihedron.tools.benchmarks.honesty import all_cases
from trihedron.tools.benchmarks.judged_runs import HEADER, Case, JudgedCase, alarms_of, cells_of, rank_by_sigma, report, rows_of, run_and_judge

SMALL = ["--rooms", "room", "--seeds", "1", "--length", "12", "--size", "160x120"]
NO_ERRORS = check_status([], Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4))))[1]
CHECK = StatusCheck(100, 100, 0, 0, 0.01, 0, 5.0, 0.9, 0.5, 10.0, 1.0, 99, 1.0, {}, 0.01)


def judged(groups: Mapping[str, str], **figures: Any) -> JudgedCase:
    return JudgedCase(Case("a", [], groups), replace(CHECK, **figures), NO_ERRORS)


def test_rows_are_sensors_rooms_clean_runs_and_faults() -> None:
    found = [judged({"fault": "frozen"}), *(judged({"sensor": s, "room": r}) for s in ("tof", "phone") for r in ("room", "bare"))]
    rows = [(row["kind"], row["name"], row["runs"], row["frames"]) for row in rows_of(found)]
    assert rows == [
        ("sensor", "tof", 2, 200), ("sensor", "phone", 2, 200), ("room", "room", 2, 200), ("room", "bare", 2, 200),
        ("all", "clean runs", 4, 400), ("fault", "frozen", 1, 100),
    ]  # fmt: skip


def test_three_runs_have_an_interval_and_two_have_none() -> None:
    runs = [
        judged({"room": "room"}, ate_m=ate, nees_median=nees, ok=ok) for ate, nees, ok in ((0.01, 1.0, 100), (0.02, 10.0, 100), (0.03, 100.0, 97))
    ]
    row = rows_of(runs)[0]
    assert row["ate_m"]["mean"] == pytest.approx(0.02)
    assert row["ate_m"]["interval"] == [pytest.approx(0.0), pytest.approx(0.02 + 4.3027 * 0.01 / np.sqrt(3), rel=1e-3)]  # t of 2 degrees of freedom
    assert row["nees_median"]["mean"] == pytest.approx(10.0) and row["nees_median"]["interval"][0] > 0.0  # geometric
    assert row["ok_share"]["mean"] == pytest.approx(0.99) and row["ok_share"]["interval"][1] == 1.0
    assert rows_of(runs[:2])[0]["ate_m"] == {"mean": pytest.approx(0.015), "interval": None}
    assert dict(zip(HEADER, cells_of(row), strict=True))["NEES"].startswith("10.0 [0.0, ")


def test_the_stated_sigma_ranks_runs_of_sensors() -> None:
    """Of four sensors σ ranks all but two as their errors do, Spearman's 0.8; faults, and runs without σ, do not count."""
    found = [judged({"sensor": "tof"}, sigma_m=sigma, ate_m=ate) for sigma, ate in ((0.01, 0.011), (0.02, 0.03), (0.03, 0.02), (0.04, 0.5))]
    others = [judged({"fault": "frozen"}, sigma_m=1.0, ate_m=0.0), judged({"sensor": "tof"}, sigma_m=None)]
    assert rank_by_sigma([*found, *others]) == {"rank_correlation": pytest.approx(0.8), "runs": 4}
    assert report(found).endswith("ranks 4 runs of simulated sensors as their ATE does: rank correlation +0.80.")
    assert rank_by_sigma(found[:2]) is None and "rank" not in report(found[:2])


def test_runs_without_truth_count_frames_and_nothing_else() -> None:
    unknown = {name: None for name in ("ate_m", "nees_median", "share_within_95", "sigma_auc", "log_likelihood", "spread_over_error")}
    row = rows_of([judged({"sequence": "desk"}, **unknown)])[0]
    assert row["wrong_ok"] is None and row["ok_share"]["mean"] == 1.0
    assert cells_of(row) == ["sequence", "desk", "1", "100", "–", "100.0", "0.0", "–", "–", "–", "–", "–", "–"]


def test_false_alarms_are_those_of_clean_runs_by_the_test() -> None:
    tof, phone = {"sensor": "tof", "room": "room"}, {"sensor": "phone", "room": "room"}
    found = [
        judged(tof, not_ok={"something moves": 1}), judged(phone, not_ok={"only … matches": 3, "something moves": 1}),
        judged({"fault": "frozen"}, not_ok={"the images repeat": 50}),
    ]  # fmt: skip
    assert [(row["test"], row["frames"], row["share"]["mean"]) for row in alarms_of(found)] == [
        ("only … matches", 3, 0.015),
        ("something moves", 2, 0.01),
    ]
    assert report(found).splitlines()[-1].split() == ["something", "moves", "2", "1.00"]
    assert rows_of(found)[-1]["not_ok"] == {"the images repeat": 50}


def test_seeds_are_not_those_of_development_and_sequences_are_whole(tmp_path: Path) -> None:
    (tmp_path / "desk").mkdir()
    (tmp_path / "desk" / "rgb.txt").touch()
    (tmp_path / "desk" / "depth.txt").touch()
    options = Namespace(sensors="tof", rooms="room,bare", seeds=2, first_seed=10, length=30, cases="frozen", size="160x120")
    cases = all_cases(options, [f"{tmp_path}/desk/", f"tum:{tmp_path}/desk frames=0:9"], ["graph=points"])
    assert [case.name for case in cases] == [
        "tof-room-10", "tof-room-11", "tof-bare-10", "tof-bare-11", "sequence-desk", "sequence-desk_frames=0_9", "frozen",
    ]  # fmt: skip
    assert {"dataset.seed=11", "dataset.width=160", "graph=points"} <= set(cases[1].words)
    assert list(cases[4].words) == ["dataset=tum", f"dataset.path={tmp_path}/desk", "outputs=[trajectory]", "graph=points"]
    assert {"+dataset.options.height=120", "+dataset.options.seed=10"} <= set(cases[6].words) and not cases[6].clean


def test_what_was_run_with_other_words_is_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = []

    def measure(words: list[str], out: Path) -> None:
        out.mkdir(exist_ok=True)
        ran.append(words)

    monkeypatch.setattr(benchmark, "measure", measure)
    monkeypatch.setattr(judged_runs, "judged_run", lambda run: (CHECK, NO_ERRORS))
    for words in (["dataset.length=10"], ["dataset.length=10"], ["dataset.length=20"]):
        run_and_judge(tmp_path / "a", words)
    assert ran == [[words, f"out={tmp_path / 'a'}"] for words in ("dataset.length=10", "dataset.length=20")]


def test_unknown_names_and_sizes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "honesty", "--sensors", "phnoe"]) == 2
    assert capsys.readouterr().err == "trihedron: benchmark: there is no 'phnoe'; did you mean 'phone'?\n"
    assert main(["benchmark", "honesty", "--size", "160"]) == 2
    assert capsys.readouterr().err == "trihedron: benchmark honesty: --size 160 is not WxH; give two numbers, for example 640x480\n"
    assert main(["benchmark", "honesty", str(tmp_path / "nowhere")]) == 1
    assert "does not exist" in capsys.readouterr().err


@pytest.mark.slow
def test_two_runs_are_judged_and_not_run_again(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["benchmark", "honesty", "--sensors", "tof,phone", "--cases", "", *SMALL, "--runs", str(tmp_path), "--json", str(tmp_path / "a.json")]
    assert main(words) == 0
    first = capsys.readouterr().out
    found = json.loads((tmp_path / "a.json").read_text())
    assert [row["name"] for row in found["rows"]] == ["tof", "phone", "room", "clean runs"]
    assert [(run["run"], run["seed"], run["frames"]) for run in found["runs"]] == [("tof-room-10", 10, 12), ("phone-room-10", 10, 12)]
    assert found["rows"][-1]["frames"] == 24 and found["rows"][-1]["ate_m"]["mean"] > 0.0 and "clean runs" in first

    def measure(*_: object) -> None:
        raise TrihedronError("it is run again")

    monkeypatch.setattr(benchmark, "measure", measure)
    assert main(words) == 0
    assert capsys.readouterr().out == first
