"""The folder of a run that another one left: replaced as a whole, and refused where that would lose what is read, or what was corrected by hand."""

from __future__ import annotations

import json

import pytest
from two_rooms import two_rooms

from trihedron.pipeline.app.cli import main
from trihedron.plugins.building.files import write_building

SMALL = ["dataset=synthetic", "dataset.width=160", "dataset.height=120", "dataset.length=2"]


def refusal(capsys, *words):
    """Return the one line of `trihedron run` on standard error."""
    assert main(["run", *words]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def named_plan(out):
    """Write the files of a building into a folder, and name its first room by hand."""
    out.mkdir()
    write_building(out, two_rooms())
    file = out / "building.json"
    found = json.loads(file.read_text())
    found["rooms"][0]["name"] = "Kitchen"
    file.write_text(json.dumps(found))
    return file


def test_a_run_does_not_lose_corrections_by_hand(tmp_path, capsys):
    out = tmp_path / "run"
    file = named_plan(out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    lost = f"trihedron: out: {file} holds corrections by hand, which would be lost; give another out=FOLDER"
    assert refusal(capsys, *SMALL, f"out={out}") == lost
    assert refusal(capsys, *SMALL, "outputs=[building]", f"out={out}") == f"{lost}, or building.edits={file}"
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert main(["run", *SMALL, "outputs=[building]", f"building.edits={file}", f"out={out}"]) == 0
    assert "Kitchen" in file.read_text()


def test_a_run_removes_what_an_earlier_one_left(tmp_path, capsys):
    out = tmp_path / "run"
    out.mkdir()
    (out / ".hydra").mkdir()
    write_building(out, two_rooms())
    for name in ("floorplan.pdf", "surface.ply", "surface.json", "trajectory.png", "metrics.json", "mine.txt"):
        (out / name).write_text("older")
    assert main(["run", *SMALL, "dataset.length=1", "outputs=[keypoints]", f"out={out}"]) == 0
    printed = capsys.readouterr().out
    names = "building.glb, building.json, floorplan.dxf, floorplan.pdf, floorplan.svg, surface.json, surface.ply"
    assert f"removed, as it was of an earlier run: {names}\n" in printed and f"{out}/metrics.json" not in printed
    assert {path.name for path in out.iterdir()} == {".hydra", "run.mcap", "timing.json", "mine.txt"}


def test_a_run_leaves_files_that_are_no_run_s(tmp_path):
    """The folder of a data set may have a mesh of its own."""
    (tmp_path / "surface.ply").write_text("of somebody")
    assert main(["run", *SMALL, "dataset.length=1", "outputs=[keypoints]", f"out={tmp_path}"]) == 0
    assert (tmp_path / "surface.ply").read_text() == "of somebody"


@pytest.mark.parametrize("reads", ["replay={}", "replay={}/run.mcap", "dataset=mcap dataset.path={}"])
def test_a_run_does_not_replace_what_it_reads(reads, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["run", *SMALL, "outputs=[keypoints]", "record.frames=true", f"out={out}"]) == 0
    before = (out / "run.mcap").read_bytes()
    capsys.readouterr()
    words = reads.format(out).split()
    key = words[-1].partition("=")[0]
    assert refusal(capsys, *words, f"out={out}") == f"trihedron: out: {out}/run.mcap would be replaced, which {key} reads; give another out=FOLDER"
    assert (out / "run.mcap").read_bytes() == before
