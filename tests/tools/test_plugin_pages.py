"""The page of a plugin has its documentation, its options, and its measured figures with their commit."""

import json
import re
import sys
from pathlib import Path

import pytest

from trihedron.pipeline.core.options import constraints_of
from trihedron.pipeline.core.registry import load_plugins, options_of, plugin_class

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs" / "site"))
from plugin_pages import RESULTS, built_in, draw, markdown, overview, page, pages, source_of  # noqa: E402

load_plugins()


@pytest.mark.parametrize("slot, name", built_in())
def test_the_page_of_a_plugin_has_its_options_source_and_dated_figures(slot, name):
    kind, text = plugin_class(slot, name), page(slot, name, json.loads(RESULTS.read_text()), False)
    assert text.startswith(f"# `{slot}={name}`\n\n{(kind.__doc__ or '').split(chr(10))[0]}")
    assert f"[Source](../../../../{source_of(slot, name)})" in text and (ROOT / source_of(slot, name)).is_file()
    rows = [line.split(" | ") for line in text.partition("## Options")[2].partition("## ")[0].splitlines() if line.startswith("| `")]
    ranges = {option: " and ".join(map(str, found)) for option, found in constraints_of(kind).items()}
    expected = [(f"| `{option.name}`", ranges.get(option.name, "")) for option in options_of(kind)]
    assert [(row[0], row[2]) for row in rows] == expected
    dated = r"Measured on commit `[0-9a-f]{12}` \(\d{4}-\d\d-\d\d\) with `make results PART=methods`"
    assert "| ATE mm" not in text or re.search(dated, text)


def test_the_index_links_each_plugin_the_default_of_its_slot_first():
    assert sorted(re.findall(r"\]\(plugins/(\w+)/(\w+)\.md\)", overview())) == sorted(built_in())
    assert "| `planes` | **[`connected_components`](plugins/planes/connected_components.md)**, [`ahc`](plugins/planes/ahc.md), " in overview()


def test_every_plugin_was_measured_and_none_failed():
    results = json.loads(RESULTS.read_text())
    assert [row for row in results["runs"] if row["note"]] == []
    measured = {row["change"] for row in results["runs"]}
    for slot in ("normals", "keypoints", "lines", "planes", "manhattan", "tracks", "rotation", "translation", "matches", "pose", "bundle", "loop"):
        for other, name in built_in():
            if other != slot or name == "none" or name.startswith("onnx"):
                continue
            if not hasattr(plugin_class(slot, name), "needs"):  # which cannot be chosen alone
                assert f"{slot}={name}" in measured
    assert {"default", "graph=libraries"} <= measured


def test_a_page():
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
    results = json.loads(RESULTS.read_text())
    assert {name for slot, name in built_in() if "## Measured" not in page(slot, name, results, False)} == {"none"}


def test_bars_are_escaped():
    assert markdown(["a"], [("x | y",)]).splitlines()[-1] == r"| x \| y |"


def test_what_needs_a_file_is_not_drawn():
    assert draw("planes", "onnx") is None


@pytest.mark.slow
def test_pages_show_what_a_plugin_finds():
    written = pages()
    assert len([place for place in written if place.endswith(".md")]) == 1 + len(built_in())
    picture = written["reference/plugins/planes/cape.jpg"]
    assert picture.startswith(b"\xff\xd8") and len(picture) > 5000
    assert "](cape.jpg)" in written["reference/plugins/planes/cape.md"] and "reference/plugins/planes/onnx.jpg" not in written
