"""Tables of methods: every plugin in the default graph, and detectors by the truth of rendered scenes."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.types import Keypoints, LineSegments, Normals
from trihedron.pipeline.sweep.sweep import words_of_alternatives
from trihedron.plugins.normals.integral_image import IntegralImage
from trihedron.plugins.planes.connected_components import ConnectedComponents
from trihedron.tools.benchmarks.detector_truth import _view, judge_keypoints, judge_lines, judge_normals, judge_planes, true_regions
from trihedron.tools.method_tables import sequence_of

sys.path.insert(0, str(Path(__file__).parent))
from faulty_plugins import faulty

__all__ = ["faulty"]  # a fixture
DATA = Synthetic(length=12, width=320, height=240, noise=False)
FIRST, SECOND = _view(DATA, 2), _view(DATA, 7)


def test_true_planes_are_those_of_the_depth():
    """Every true plane contains the points that show it."""
    depth, labels, planes = DATA.true_planes(3)
    rows, columns = np.nonzero(labels >= 0)
    points = FIRST.frame.camera.back_project(np.stack([columns, rows], axis=1).astype(float), depth[rows, columns])
    distances = (planes[labels[rows, columns], :3] * points).sum(axis=1) + planes[labels[rows, columns], 3]
    assert np.abs(distances).max() < 1e-6 and (planes[:, 3] >= 0.0).all()


def test_true_normals_are_exact_and_others_are_not():
    def normals(view, noise):
        labels = view.labels
        value = np.where((labels >= 0)[..., None], view.planes[labels, :3], np.nan) + noise
        value /= np.linalg.norm(value, axis=-1, keepdims=True)
        return Normals(0, 0, value.astype(np.float32), 1)

    exact = judge_normals(FIRST, SECOND, normals(FIRST, 0.0), normals(SECOND, 0.0))
    assert exact["median deg"] < 0.05 and exact["share"] == 1.0
    tilted = judge_normals(FIRST, SECOND, normals(FIRST, [0.1, 0.0, 0.0]), normals(SECOND, [0.1, 0.0, 0.0]))
    assert 2.0 < tilted["median deg"] < 6.0


def test_true_regions_are_found_and_halves_are_not():
    found = [ConnectedComponents()(view.frame, IntegralImage()(view.frame)) for view in (FIRST, SECOND)]
    truth = [true_regions(view, value.stride) for view, value in zip((FIRST, SECOND), found)]
    values = []
    for value, (regions, planes) in zip(found, truth):
        k = min(len(value.coefficients), len(planes))
        order = np.argsort(-np.bincount(regions.ravel(), minlength=len(planes) + 1)[1:])[:k]
        labels = np.zeros(regions.shape, np.uint8)
        for number, region in enumerate(order):
            labels[regions == region + 1] = number + 1
        shortened = {name: getattr(value, name)[:k] for name in ("covariance", "moments", "pixels", "samples_m")}
        values.append(replace(value, coefficients=planes[order], labels=labels, **shortened))
    figures = judge_planes(FIRST, SECOND, *values)
    assert figures["precision"] == 1.0 and figures["deg"] < 1e-3 and figures["mm"] < 1e-3
    halves = [replace(value, labels=value.labels * (np.arange(value.labels.shape[1]) % 2 == 0).astype(np.uint8)) for value in values]
    assert judge_planes(FIRST, SECOND, *halves)["precision"] == 0.0


def keypoints(pixels, descriptors):
    n = len(pixels)
    one = np.ones(n, np.float32)
    return Keypoints(0, 0, pixels.astype(np.float32), np.full((n, 3), np.nan, np.float32), one, one, np.zeros(n, np.uint8), one, descriptors)


def test_points_at_their_true_places_repeat_and_match():
    rng = np.random.default_rng(0)
    pixels = rng.uniform([40, 40], [280, 200], (60, 2))
    places, visible = FIRST.seen_from(SECOND, np.rint(pixels))
    pixels, places = np.rint(pixels)[visible], places[visible]
    descriptors = rng.integers(0, 256, (len(pixels), 32)).astype(np.uint8)
    figures = judge_keypoints(FIRST, SECOND, keypoints(pixels, descriptors), keypoints(places, descriptors))
    assert figures["repeatability"] > 0.95 and figures["matching score"] > 0.95
    swapped = judge_keypoints(FIRST, SECOND, keypoints(pixels, descriptors), keypoints(places, np.roll(descriptors, 1, axis=0)))
    assert swapped["matching score"] < 0.2 and swapped["repeatability"] == figures["repeatability"]


def test_lines_at_their_true_places_repeat():
    starts = np.array([[60.0, 60.0], [100.0, 150.0], [200.0, 90.0]])
    ends = starts + np.array([[30.0, 2.0], [5.0, 30.0], [25.0, 20.0]])
    moved = [FIRST.seen_from(SECOND, points)[0] for points in (starts, ends)]

    def lines(one, other):
        return LineSegments(0, 0, np.stack([one, other], axis=1).astype(np.float32), np.zeros((3, 32), np.uint8))

    assert judge_lines(FIRST, SECOND, lines(starts, ends), lines(*moved))["repeatability"] > 0.6
    assert judge_lines(FIRST, SECOND, lines(starts, ends), lines(*(points + 25.0 for points in moved)))["repeatability"] < 0.4


def test_alternatives_are_one_change_each():
    found = words_of_alternatives(["lines", "model pose=icp", "graph=points threads=1"])
    assert found[0] == [] and ["lines=opencv_lsd"] in found and ["lines=none"] not in found and ["lines=onnx"] not in found
    assert ["model=tsdf", "pose=icp"] in found and found[-1] == ["graph=points", "threads=1"]
    assert words_of_alternatives([]) == []


def test_sequences_have_short_names():
    assert sequence_of(["dataset=synthetic", "dataset.length=60", "without=loop"]) == "room without=loop"
    assert sequence_of(["dataset=synthetic", "dataset.scene=flat", "dataset.fps=10"]) == "flat fps=10"
    assert sequence_of(["dataset=faults", r"dataset.cover=20\:35", "+dataset.options.length=60"]) == "faults cover=20:35"
    assert sequence_of(["dataset=tum", "dataset.path=/data/desk", "pose=icp"]) == "desk pose=icp"


@pytest.mark.slow
def test_a_sweep_over_alternatives_and_its_table(tmp_path, capsys, faulty):
    """The open loop tells the translation of wrong sign from the default, the ATE does not: refinement against the map hides it."""
    small = "length=12 fps=10 width=160 height=120"
    places = f"sequences=[synthetic {small},synthetic {small} texture=false without=loop alternatives=rotation]"
    changes = "alternatives=[translation=wrong_sign,translation=irls,rotation=procrustes,rotation=ransac]"
    assert main(["run", "-m", places, changes, "report=benchmark methods", "hydra/launcher=basic", f"out={tmp_path}"]) == 0
    overrides = [yaml.safe_load((tmp_path / job / ".hydra" / "overrides.yaml").read_text()) for job in ("0", "3", "6")]
    assert ["rotation=procrustes" in words for words in overrides] == [False, True, True] and "without=loop" in overrides[2]
    printed = capsys.readouterr().out.splitlines()
    assert main(["benchmark", "methods", str(tmp_path), "--json", str(tmp_path / "methods.json")]) == 0
    again = capsys.readouterr()
    lines = again.out.splitlines()
    assert lines == printed[: len(lines)] and again.err.count("done already") == 3
    assert lines[0].split() == ["translation", "ATE", "1", "NEES", "ms", "MB", "translation", "mm", "translation", "cycle", "px"]
    assert lines[5].split() == ["rotation", "ATE", "1", "ATE", "2", "NEES", "ms", "MB", "rotation", "deg"]
    assert [line.split()[0] for line in lines[6:9]] == ["default", "rotation=procrustes", "rotation=ransac"]
    assert lines[-1] == "8 runs, 0 failed" and lines[-3].startswith("ATE 2: room ") and lines[-3].endswith("texture=False without=loop")
    rows = {(row["change"], row["sequence"]): row for row in json.loads((tmp_path / "methods.json").read_text())["runs"]}
    first, second = dict.fromkeys(sequence for _, sequence in rows)
    assert [change for change, sequence in rows if sequence == second] == ["default", "rotation=procrustes", "rotation=ransac"]
    assert all(row["tracked"] > 0.5 and 0.0 < row["ate_mm"] < 50.0 and row["measures"] for row in rows.values())
    assert set(rows["default", first]["measures"]) == {"rotation deg", "translation mm", "translation cycle px"}
    default, wrong = rows["default", first], rows["translation=wrong_sign", first]
    assert abs(wrong["ate_mm"] - default["ate_mm"]) < 0.2 * default["ate_mm"]
    assert wrong["measures"]["translation mm"] > 3.0 * default["measures"]["translation mm"]


@pytest.mark.slow
def test_surfaces_and_buildings_have_measures_by_the_true_ones(tmp_path, capsys):
    small = ["dataset.width=160", "dataset.height=120", "dataset.length=24", "dataset.fps=3"]  # a path long enough to be aligned
    changes = "alternatives=['surface=tsdf outputs=[trajectory,surface]','building=manhattan_layout outputs=[trajectory,building]']"
    assert main(["run", "-m", *small, changes, "report=benchmark methods", "hydra/launcher=basic", f"out={tmp_path}"]) == 0
    assert "missed surface %" in capsys.readouterr().out
    assert main(["benchmark", "methods", str(tmp_path), "--json", str(tmp_path / "methods.json")]) == 0
    default, surface, building = (row["measures"] for row in json.loads((tmp_path / "methods.json").read_text())["runs"])
    assert default == {}
    assert 0.0 < surface["surface mm"] < 30.0 and 0.0 <= surface["missed surface %"] < 10.0
    assert 0.0 < building["walls mm"] < 100.0 and building["missed rooms %"] == building["false rooms %"] == 0.0


def test_a_detector_that_is_no_slot(capsys):
    assert main(["benchmark", "detectors", "--slots", "plane"]) == 2
    assert capsys.readouterr().err == "trihedron: benchmark detectors: 'plane' is no slot of detectors; did you mean 'planes'?\n"


@pytest.mark.slow
def test_all_detectors_are_judged(tmp_path, capsys):
    assert main(["benchmark", "detectors", "--pairs", "1", "--json", str(tmp_path / "figures.json")]) == 0
    found = json.loads((tmp_path / "figures.json").read_text())
    assert set(found) == {"normals", "keypoints", "lines", "planes"}
    assert found["planes"]["connected_components"]["room"]["precision"] > 0.5
    assert found["keypoints"]["orb"]["room"]["repeatability"] > 0.5
