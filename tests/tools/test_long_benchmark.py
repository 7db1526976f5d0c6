"""`trihedron benchmark long`: what a run leaves behind while the camera sees the same again and again."""

import json
import re

import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.tools.benchmarks.long_run import BackAndForth, Row, report

SMALL = ["dataset.width=160", "dataset.height=120"]


def test_frames_come_forwards_and_backwards():
    shown = BackAndForth((None,) * 4, 20)
    assert [shown.source_index(index) for index in range(9)] == [0, 1, 2, 3, 2, 1, 0, 1, 2] and len(shown) == 20
    assert [BackAndForth((None,), 3).source_index(index) for index in range(3)] == [0, 0, 0]


@pytest.mark.parametrize("worse, verdict", [({}, 0), ({"memory_mb": 530.0}, 1), ({"handles": 8}, 1), ({"p95_ms": 34.0}, 1), ({"multiple": 1.2}, 1)])
def test_each_promise_can_be_broken(worse, verdict):
    rows = [Row(1000 * k, 500.0, 7, 5, 20, 3000, 3.0, 20.0, 30.0, 1.0, 5.0, 0) for k in range(1, 6)]
    said, kept = report([*rows[:-1], Row(**{**vars(rows[-1]), **worse})], 2000)
    assert said.count("NOT MET") == verdict and kept is not bool(verdict)


@pytest.mark.slow
def test_a_short_run_holds_what_it_did(tmp_path, capsys):
    """Three times to and fro over 20 frames: no keyframes, handles and threads more; what time says is the slow test's."""
    words = ["benchmark", "long", "--frames", "120", "--loop", "20", "--warm-up", "30", "--span", "30", "--json", str(tmp_path / "long.json"), *SMALL]
    assert main(words) in (0, 1)
    rows = json.loads((tmp_path / "long.json").read_text())["rows"]
    assert [row["frames"] for row in rows] == [30, 60, 90, 120] and "no more handles and threads" in capsys.readouterr().out
    assert len({(row["handles"], row["threads"]) for row in rows[1:]}) == 1 and not any(row["not_ok"] for row in rows)
    assert max(row["keyframes"] for row in rows) < 10 and rows[-1]["landmarks"] < 1.2 * rows[1]["landmarks"]
    assert max(row["most_mm"] for row in rows) < 30.0


@pytest.mark.slow
def test_four_thousand_frames(capsys):
    """Memory, handles and the map are as flat as for twenty thousand. Times are as the machine is, and so are their multiples beside other work."""
    main(["benchmark", "long", "--frames", "4000", "--loop", "60", "--warm-up", "1000", *SMALL])
    said = capsys.readouterr().out
    print(said)
    assert re.search(r"^met: memory grew", said, re.M) and "\nmet: no more handles" in said
    figures = np.array([line.split() for line in said.splitlines() if re.match(r" *\d+ ", line)][1:], float)
    assert np.ptp(figures[:, 4]) <= 4 and figures[-1, 6] < 1.5 * figures[0, 6] and not figures[:, 11].any()


def test_too_few_frames_are_refused(capsys):
    assert main(["benchmark", "long", "--frames", "100"]) == 2
    assert "too few frames for two rows" in capsys.readouterr().err
