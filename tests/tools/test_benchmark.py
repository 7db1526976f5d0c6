"""The benchmark's tables on known figures, and the commands on tiny runs."""

import copy
import json
import re

import cv2
import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.tools.benchmark import measure
from trihedron.tools.benchmark_comparison import comparison_table

FIGURES = {
    "frames": 10, "threads": 2, "fps": 50.0, "frame_ms": {"p50": 20.0, "p95": 30.0}, "reference_ms": 10.0,
    "stages": {"planes": {"p50_ms": 5.0, "p95_ms": 6.0}, "loop": {"p50_ms": 0.05, "p95_ms": 0.1}},
}  # fmt: skip
TINY = ["dataset.width=160", "dataset.height=120", "dataset.length=6"]


def test_a_slower_machine_makes_nothing_slower():
    slow = copy.deepcopy(FIGURES)
    slow["reference_ms"], slow["fps"], slow["frame_ms"]["p50"] = 20.0, 25.0, 40.0
    for stage in slow["stages"].values():
        stage["p50_ms"] *= 2.0
    said = comparison_table(FIGURES, slow)
    assert "nothing became slower" in said and said.count("+0 %") == 4


def test_what_became_slower_is_named_and_tiny_stages_are_not():
    new = copy.deepcopy(FIGURES)
    new["stages"]["planes"]["p50_ms"], new["stages"]["loop"]["p50_ms"] = 6.0, 0.1
    new["stages"]["lines"] = {"p50_ms": 1.0, "p95_ms": 1.0}
    said = comparison_table(FIGURES, new)
    assert said.splitlines()[-1] == "slower: planes"
    assert "+20 %" in said and "new" in said


@pytest.mark.slow
def test_the_benchmark_writes_what_it_compares_with(tmp_path, capsys):
    file = tmp_path / "old.json"
    assert main(["benchmark", *TINY, "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    assert figures["frames"] == 6 and figures["cli_cpu_s"] > 0.0 and set(figures["machine"]["packages"]) >= {"numpy", "numba"}
    assert f"reference workload {figures['reference_ms']:.1f} ms" in capsys.readouterr().out
    before, after = figures["reference_each_ms"]
    assert min(before, after) <= figures["reference_ms"] <= max(before, after)


@pytest.mark.slow
def test_the_memory_of_a_run_is_not_that_of_who_measures_it(tmp_path):
    """It is about what importing takes, though 700 MB are held here."""
    held = np.ones(700 << 20, np.uint8)
    figures = measure([*TINY, f"out={tmp_path / 'run'}"], tmp_path / "run")
    assert 100 < figures["peak_memory_mb"] < 0.9 * held.nbytes / 1e6


@pytest.mark.parametrize(
    "words, said",
    [
        (["maps"], "benchmark: 'maps' is neither key=value, a comparison nor an existing folder; did you mean 'map'?"),
        (["--compare", "none.json"], "none.json: cannot be read (No such file or directory); give a file written by trihedron benchmark --json"),
    ],
)
def test_mistakes_take_one_line(words, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["benchmark", *words]) != 0
    assert said in capsys.readouterr().err


def test_every_layout_of_a_folder_is_measured(tmp_path, capsys):
    """A folder is enough: the data set is chosen by its files, and the CPU time of a frame stands beside the time of the clock."""
    rng = np.random.default_rng(1)
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
    for k in range(3):
        cv2.imwrite(str(tmp_path / "rgb" / f"{k}.png"), rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
        cv2.imwrite(str(tmp_path / "depth" / f"{k}.png"), np.tile(np.arange(2000, 2064, dtype=np.uint16), (48, 1)))
    (tmp_path / "camera.yaml").write_text("{width: 64, height: 48, fx: 60, fy: 60, cx: 31.5, cy: 23.5, depth_scale: 1000}\n")
    assert main(["benchmark", str(tmp_path), "outputs=[normals]", "record.topics=[]", "--one-core"]) == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[1].startswith("3 frames, ") and "start-up included: " in printed and " ms a frame; peak memory " in printed
    assert re.search(
        r"^on one core at the camera's rate: \d of \d frames taken \(\d+.\d%\), p50 .* x reference\), .* ms of CPU a frame$", printed, re.M
    )


def test_another_file_is_no_benchmark(capsys, tmp_path):
    (tmp_path / "other.json").write_text("{}")
    assert main(["benchmark", "--compare", str(tmp_path / "other.json")]) != 0
    assert "holds no figures of a benchmark" in capsys.readouterr().err


@pytest.mark.parametrize(("word", "place"), [("dataset=nope", "dataset"), ("dataset.nope=3", "dataset.nope")])
def test_a_run_that_cannot_be_composed_is_one_line(word, place, capsys):
    assert main(["benchmark", word]) == 1
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"trihedron: {place}: ") and "\n" not in said
