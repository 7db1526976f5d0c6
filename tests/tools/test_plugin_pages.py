"""The pages of the plugins are those that their sources and the file of measured figures give."""

import json
from pathlib import Path

import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.registry import load_plugins, plugin_class
from trihedron.tools.plugin_pages import built_in, markdown, page, read_results

ROOT = Path(__file__).parents[2]
PAGES, RESULTS = ROOT / "docs" / "reference" / "plugins", ROOT / "docs" / "results" / "methods.json"
AGAIN = "write them again: trihedron plugins --pages docs/reference/plugins --results docs/results/methods.json"
load_plugins()


def test_pages_are_up_to_date():
    results = read_results(RESULTS)
    for slot, name in built_in():
        path = PAGES / slot / f"{name}.md"
        assert path.is_file(), f"{path}: {AGAIN}"
        assert path.read_text() == page(slot, name, results, path.with_suffix(".jpg").exists()), f"{path}: {AGAIN}"
    assert {(path.parent.name, path.stem) for path in PAGES.glob("*/*.md")} == set(built_in())


def test_every_plugin_was_measured_and_none_failed():
    results = read_results(RESULTS)
    assert [row for row in results["runs"] if row["note"]] == []
    measured = {row["change"] for row in results["runs"]}
    for slot in ("normals", "keypoints", "lines", "planes", "manhattan", "tracks", "rotation", "translation", "matches", "pose", "bundle", "loop"):
        for other, name in built_in():
            if other != slot or name == "none" or name.startswith("onnx"):
                continue
            if not hasattr(plugin_class(slot, name), "needs"):  # which cannot be chosen alone
                assert f"{slot}={name}" in measured
    assert {"default", "graph=libraries"} <= measured


def test_a_page(tmp_path):
    run = {
        "change": "planes=cape",
        "sequence": "room",
        "ate_mm": 1.25,
        "tracked": 0.5,
        "nees": 1.0,
        "ms": 9.0,
        "frame_ms": 20.0,
        "mb": 400,
        "note": "",
    }
    left_out = {**run, "change": "without=planes", "ate_mm": 3.0}
    results = {"runs": [{**run, "change": "default", "ate_mm": 1.0}, run, left_out], "detectors": {"planes": {"cape": {"room": {"recall": 0.25}}}}}
    text = page("planes", "cape", results, False)
    assert text.startswith("# `planes=cape`\n\nCell-wise plane extraction")
    assert "| room | 1.2 | 50 | 1.00 | 9.0 | 20.0 | 400 | 1.0 |" in text
    measured = {**run, "measures": {"planes mm": 3.456}}
    assert "| 400 | 1.0 | 3.46 |" in page("planes", "cape", {**results, "runs": [*results["runs"], measured]}, False)
    assert "| room | 0.25 |" in text and "Without the stage (`without=planes`)" in text and "| room | 3.0 | 50 | 1.00 | 1.0 |" in text
    assert "| `cone_deg` | `15.0` | above 0 and at most 45 | normals of one plane lie within this of it |" in text


def test_a_page_states_commit_command_and_scale_of_its_figures():
    run = {"sequence": "room", "ate_mm": 1.0, "tracked": 1.0, "nees": 5.0, "ms": 9.0, "frame_ms": 20.0, "mb": None, "note": ""}
    head = {"commit": "abc", "date": "2026-01-02", "command": "make it", "packages": {"numpy": "2"}, "processor": None, "cpus": 2, "python": None}
    runs = [{**run, "change": "default"}, {**run, "change": "model=tsdf pose=icp"}]
    text = page("model", "tsdf", {**head, "runs": runs, "detectors": {}}, False)
    assert "with `model=tsdf pose=icp` (`trihedron run -m experiment=methods`); NEES is 5.35 where covariances are right" in text
    assert text.endswith("*Measured on commit `abc` (2026-01-02) with `make it`: numpy 2; 2 cores.*\n")


@pytest.mark.parametrize(
    "slot, name, command",
    [
        ("surface", "tsdf", "trihedron run -m experiment=methods 'alternatives=[\"surface outputs=[trajectory,surface]\"]' out=runs/surface"),
        ("segments", "ransac", "trihedron ablate RUN.mcap segments=ransac out=runs/segments"),
        ("normals", "onnx", "trihedron run normals=onnx normals.model=FILE.onnx"),
        ("dataset", "tum", "trihedron benchmark FOLDER"),
    ],
)
def test_a_page_without_figures_names_the_command_that_gives_them(slot, name, command):
    text = page(slot, name, {"runs": [], "detectors": {}}, False)
    assert f"`{command}`" in text.split("## Measured")[1]


def test_only_stages_that_do_nothing_have_no_section_of_figures():
    results = read_results(RESULTS)
    assert {name for slot, name in built_in() if "## Measured" not in page(slot, name, results, False)} == {"none"}


def test_bars_are_escaped():
    assert markdown(["a"], [("x | y",)]).splitlines()[-1] == r"| x \| y |"


@pytest.mark.slow
def test_the_command_writes_all_pages_with_figures(tmp_path, capsys):
    (tmp_path / "results.json").write_text(json.dumps({"runs": [], "detectors": {}}))
    assert main(["plugins", "--pages", str(tmp_path), "--results", str(tmp_path / "results.json"), "--figures"]) == 0
    assert capsys.readouterr().out.startswith(f"{len(built_in())} pages in ")
    assert (tmp_path / "planes" / "cape.jpg").stat().st_size > 5000
