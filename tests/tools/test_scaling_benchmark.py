"""`trihedron benchmark scaling`: its figures, tables and picture on what is known, and a tiny run of it."""

import json

import cv2
import matplotlib.colors
import numpy as np
import pytest

from trihedron.pipeline.app.cli import main
from trihedron.tools.benchmarks import scaling_benchmark, scaling_plot
from trihedron.tools.benchmarks.scaling_benchmark import FIRST, PARTS, STOP, measures, report
from trihedron.tools.benchmarks.scaling_plot import figure_of

TINY = ["dataset.width=160", "dataset.height=120"]


def row(name, ms=20.0, points=4000, memory_mb=400.0):
    readers = {"matches": 1.5, "pose": 2.5, "map": 11.0}
    times = {"frame_ms": ms, "after_features_ms": ms / 4.0, "readers_ms": readers, "reference_ms": 10.0, "fps": 25.0}
    return {"name": name, "frames": 150, "points": points, "memory_mb": memory_mb, "ate_m": 0.00113, **times}


FIGURES = {
    "threads": [row("1"), row("2")],
    "image": [row("320x240", 15.0), row("1280x960", 60.0, memory_mb=700.0)],
    "features": [row("250"), row("2000")],
    "map": [row("50", 20.0, 3512), row("2200", 24.0, 63876)],
    "length": [row("100"), row("5000")],
}


def written(path, figures):
    path.write_text(json.dumps(figures))
    return str(path)


def test_a_frame_is_the_median_of_its_stages_together_without_its_rendering():
    """Three frames of 10, 13 and 34 ms; the second has no bundle adjustment. The map's 95th percentile is nearly that of its one keyframe."""
    each = [(5.0, 4.0, 0.0, 1.0, 300.0), (6.0, 7.0, 0.0, None, 420.0), (8.0, 5.0, 20.0, 1.0, 410.0)]
    timing = []
    for normals, pose, map, bundle, memory_mb in each:
        stages = {"dataset": 500.0, "normals": normals, "pose": pose, "map": map}
        timing.append({"memory_mb": memory_mb, "stage_ms": stages if bundle is None else stages | {"bundle": bundle}})
    found = measures(timing)
    assert found["frame_ms"] == 13.0 and found["after_features_ms"] == 7.0 and found["memory_mb"] == 420.0
    assert found["readers_ms"] == {"pose": 5.0, "map": pytest.approx(18.0), "bundle": 1.0}


def test_the_maps_are_of_the_same_frames():
    """However long the walk before them: all end with the same ones, and the walk through ten rooms has them on its first round."""
    for name, words in PARTS["map"].items():
        assert words == [f"dataset.length={STOP}", f"dataset.frames={FIRST - int(name)}:{STOP}"] and int(name) <= FIRST
    counts = [int(name) for name in PARTS["map"]]
    assert min(np.array(counts[1:]) / counts[:-1]) > 2.0


def test_the_tables_say_what_was_measured():
    lines = report("image", FIGURES["image"]).splitlines()
    assert lines[2].split() == ["1280x960", "4000", "60.0", "15.0", "6.00", "25.0", "700", "1.13"]
    head, *rows = report("map", FIGURES["map"]).splitlines()
    assert "matches  pose  map p95  x reference" in head and "bundle" not in head
    assert rows[1].split() == ["2200", "63876", "24.0", "6.0", "1.5", "2.5", "11.0", "2.40", "25.0", "400", "1.13"]


def test_the_picture_shows_the_tables():
    figure = figure_of(FIGURES)
    panels = np.array(figure.axes).reshape(3, len(FIGURES))
    curves = {line.get_label(): line for line in panels[0, 3].lines}
    assert curves["all stages"].get_xydata().tolist() == [[3512.0, 20.0], [63876.0, 24.0]]
    assert curves["those after the features"].get_ydata().tolist() == [5.0, 6.0]
    assert panels[1, 1].lines[0].get_xydata().tolist() == [[320.0, 1.5], [1280.0, 6.0]]
    assert panels[2, 1].lines[0].get_ydata().tolist() == [400.0, 700.0]
    assert panels[0, 0].lines[2].get_ydata().tolist() == [40.0, 40.0]  # 25 frames/s
    assert all(axes.get_xscale() == "log" and axes.get_ylim()[0] == 0.0 for axes in panels.ravel())
    assert panels[0, 0].get_ylim() == panels[0, 1].get_ylim() and panels[0, 1].get_ylim()[1] > 60.0
    assert [tick.get_text() for tick in panels[2, 3].get_xticklabels()] == ["3512", "64k"]


def test_parts_measured_one_by_one_are_drawn_together(tmp_path, capsys):
    """The later file's threads; nothing is run."""
    one = written(tmp_path / "one.json", FIGURES)
    two = written(tmp_path / "two.json", {"machine": {}, "threads": [row("1", 33.3)]})
    png, both = tmp_path / "all.png", tmp_path / "all.json"
    assert main(["benchmark", "scaling", "--draw", one, two, "--png", str(png), "--json", str(both)]) == 0
    image = cv2.imread(str(png))
    assert image.shape[1] == 900 and png.stat().st_size < 120_000
    found = {tuple(color) for color in image.reshape(-1, 3)[:, ::-1].tolist()}
    for name in (scaling_plot.ALL, scaling_plot.AFTER, scaling_plot.MULTIPLE, scaling_plot.MEMORY):
        assert tuple(round(255 * part) for part in matplotlib.colors.to_rgb(name)) in found
    figures, said = json.loads(both.read_text()), capsys.readouterr().out
    assert [one["frame_ms"] for one in figures["threads"]] == [33.3] and "33.3" in said
    assert figures["map"] == FIGURES["map"] and said.count("x reference") == 5


@pytest.mark.parametrize(
    "words, said",
    [
        ("--parts thread", "benchmark scaling: there is no part 'thread'; did you mean 'threads'?"),
        ("--lengths few", "benchmark scaling: --lengths 'few' is not a list of numbers of frames; write 100,1000,5000"),
        ("--json nowhere/a.json", "nowhere does not exist; make it first"),
        ("--draw none.json", "none.json: cannot be read (No such file or directory); give files written by trihedron benchmark scaling --json"),
        ("--draw other.json", "other.json: holds no figures of benchmark scaling; give files written by trihedron benchmark scaling --json"),
        ("--draw part.json", "part.json: holds no figures of benchmark scaling; give files written by trihedron benchmark scaling --json"),
    ],
)
def test_mistakes_take_one_line(words, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "other.json", {"frames": 10})
    written(tmp_path / "part.json", {"threads": [{"name": "1"}]})
    assert main(["benchmark", "scaling", *words.split()]) != 0
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


@pytest.mark.slow
def test_a_tiny_run(tmp_path, monkeypatch, capsys):
    """Ten frames beside maps of two sizes, and two walks."""
    monkeypatch.setattr(scaling_benchmark, "FIRST", 40)
    monkeypatch.setattr(scaling_benchmark, "STOP", 50)
    monkeypatch.setitem(PARTS, "map", {str(n): ["dataset.length=50", f"dataset.frames={40 - n}:50"] for n in (10, 40)})
    png, file = tmp_path / "scaling.png", tmp_path / "scaling.json"
    assert main(["benchmark", "scaling", *TINY, "--parts", "map,length", "--lengths", "4,6", "--png", str(png), "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    small, large = figures["map"]
    assert (small["frames"], large["frames"]) == (20, 50) and 0 < 1.2 * small["points"] < large["points"]
    assert set(small["readers_ms"]) >= {"matches", "pose", "map"} and 0.0 < small["after_features_ms"] < small["frame_ms"]
    assert [one["frames"] for one in figures["length"]] == [4, 6] and png.stat().st_size > 1000
    assert all(one["memory_mb"] > 100.0 for one in figures["length"])
    assert "key points" not in capsys.readouterr().out
