"""Published figures have one source: pages are what docs/results gives, and state no measured figure of their own without commit and command."""

import importlib.util
import json
import re
import subprocess
from pathlib import Path

import pytest

from trihedron.pipeline.core.errors import DataError

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
AGAIN = "write it again: python docs/results/render.py"
OLDER = {  # files of other commits than sequences.json, and why
    "methods.json": "takes an hour; its note says under which conditions",
    "honesty.json": "takes half an hour",
}
UNITS = r"(?:mm|cm|deg|°|ms|frames/s|MB)"
NUMBER = re.compile(rf"\d\s?{UNITS}(?![\w/])|NEES\D{{0,40}}\d")
COLUMN = re.compile(r"\b(?:ATE|RPE|NEES|mm|deg|ms|MB)\b|frames/s|°")
CONSTANTS = re.compile(r"\b(?:5\.35|2\.37|12\.6)\b")  # of χ²
DATED = re.compile(r"Measured on commit `[0-9a-f]{7,12}` \(\d{4}-\d\d-\d\d\) with `(?:trihedron|make results) [^`]+`")
HIDDEN = re.compile(r"<!-- results: \w+ -->.*?<!-- end of results -->|^```.*?^```|`[^`\n]*`", re.MULTILINE | re.DOTALL)  # blocks and code
JUDGED = [ROOT / "README.md", *(ROOT / "docs" / "explanation" / f"{name}.md" for name in ("results", "systems", "performance"))]


def program(name):
    spec = importlib.util.spec_from_file_location(name, RESULTS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


render, measure = program("render"), program("measure")


def undated(page):
    """Lines of a page with a measured figure outside of blocks and code, in sections that state neither commit nor command."""
    found = []
    for section in re.split(r"^(?=#+ )", page, flags=re.MULTILINE):
        text = HIDDEN.sub("", section)
        if DATED.search(section):
            continue
        header = ""
        for line in text.splitlines():
            header = (header or line) if line.startswith("|") else ""
            cells = line.startswith("|") and line != header and COLUMN.search(header) and re.search(r"\d", line)
            if cells or NUMBER.search(CONSTANTS.sub("", line)):
                found.append(line)
    return found


@pytest.mark.parametrize("name", render.PAGES)
def test_blocks_are_what_their_files_give(name):
    page = (ROOT / name).read_text()
    assert render.BLOCK.search(page) and render.render_page(page) == page, f"{name}: {AGAIN}"


def test_every_file_states_its_commit_and_files_of_other_commits_a_reason():
    files = {path.name: json.loads(path.read_text()) for path in RESULTS.glob("*.json")}
    for found in files.values():
        assert {"part", "command", "commit", "date", "processor", "cpus", "python", "packages"} <= set(found)
        assert re.fullmatch("[0-9a-f]{12}", found["commit"])
    others = {name for name, found in files.items() if found["commit"] != files["sequences.json"]["commit"]}
    assert others <= set(OLDER)
    for name in others:
        assert files[name].get("note", "").lower() in render.source_line(files[name]).lower()


@pytest.mark.parametrize("page", JUDGED, ids=lambda path: path.stem)
def test_measured_figures_are_rendered_or_state_commit_and_command(page):
    assert undated(page.read_text()) == []


@pytest.mark.parametrize(
    "text, count",
    [
        ("The error is 5.2 mm.", 1),
        ("It takes 20 ms a frame at 60 frames/s.", 1),
        ("The median NEES is 33.", 1),
        ("NEES is 5.35 where covariances are right.", 0),
        ("| ATE, mm | NEES |\n|---|---|\n| 1.2 | 5.0 |", 1),
        ("<!-- results: a -->\n| ATE mm |\n|---|\n| 1.0 |\n<!-- end of results -->", 0),
        ("```text\nATE 5 mm\n```\n`--max 5 mm`", 0),
        ("Measured on commit `0123abc` (2026-01-02) with `trihedron run`: 5 mm.\n\n## Next\n\n5 mm", 1),
    ],
)
def test_a_figure_without_a_source_is_found(text, count):
    assert len(undated(text)) == count


def test_figures_of_changed_code_are_refused(tmp_path):
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "a.py").write_text("1\n")
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "a"]):
        subprocess.run([*git, *words], check=True)
    commit = measure.commit_of(tmp_path)
    assert re.fullmatch("[0-9a-f]{12}", commit)
    (tmp_path / "README.md").write_text("pages are not measured\n")
    for words in (["add", "."], ["commit", "-qm", "b"]):
        subprocess.run([*git, *words], check=True)
    assert measure.commit_of(tmp_path) == commit
    (tmp_path / "plugins" / "a.py").write_text("2\n")
    with pytest.raises(DataError, match=r"plugins/a.py: is changed and not committed.*; commit it, or stash it"):
        measure.commit_of(tmp_path)


def test_a_sequence_that_this_commit_has_measured_is_not_measured_again(tmp_path, monkeypatch):
    counted = []
    monkeypatch.setattr(measure, "WORK", tmp_path)
    monkeypatch.setattr(measure, "figures_of", lambda words, out: counted.append(words[0]) or {"seconds": 30.0})
    first = measure.sequences(["tum:desk"], "a")
    assert first == measure.sequences(["tum:desk"], "a") and len(counted) == 2
    assert first == {"minutes": 1.0, "sequences": [{"sequence": "synthetic length=150", "seconds": 30.0}, {"sequence": "desk", "seconds": 30.0}]}
    measure.sequences(["tum:desk"], "b")
    assert len(counted) == 4


def test_methods_are_measured_on_the_experiments_sequences_and_the_given_ones():
    found = measure.sequences_of_methods(["tum:desk", "tum:hall frames=0:60 alternatives=manhattan"])
    assert found[0].startswith("synthetic length=60 alternatives=normals") and len(found) == 14
    assert found[12:] == ["tum:desk " + measure.TRACKING, "tum:hall frames=0:60 alternatives=manhattan"]


def test_methods_of_another_commit_are_measured_again(tmp_path, monkeypatch):
    def program(*words):
        called.append(words)
        (tmp_path / "b" / "methods.json").write_text('{"runs": []}')

    called = []
    monkeypatch.setattr(measure, "WORK", tmp_path)
    monkeypatch.setattr(measure, "_program", program)
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "detectors.json").write_text("{}")
    assert measure.methods([], "b")["runs"] == []
    assert [words[:2] for words in called] == [("run", "-m"), ("benchmark", "detectors"), ("benchmark", "methods")]
    assert f"out={tmp_path / 'b' / 'methods'}" in called[0]


def test_honesty_is_measured_on_the_given_sequences_and_kept_by_commit(tmp_path, monkeypatch):
    def program(*words):
        called.append(words)
        (tmp_path / "b" / "honesty" / "honesty.json").write_text('{"rows": [], "alarms": [], "runs": []}')

    called = []
    monkeypatch.setattr(measure, "WORK", tmp_path)
    monkeypatch.setattr(measure, "_program", program)
    assert measure.honesty(["tum:desk"], "b") == {"minutes": 0.0, "rows": [], "alarms": [], "runs": []}
    folder = tmp_path / "b" / "honesty"
    assert called == [("benchmark", "honesty", "tum:desk", "--runs", str(folder), "--json", str(folder / "honesty.json"))]


def test_blocks_of_honesty_part_clean_runs_from_faults(monkeypatch):
    figures = {name: {"mean": 1.0, "interval": [0.5, 1.5]} for name in ("ok_share", "lost_share", "ate_m", "nees_median", "share_within_95")}
    figures |= dict.fromkeys(("sigma_auc", "log_likelihood", "spread_over_error"))
    row = {"runs": 3, "frames": 30, "not_ok": {}, **figures}
    found = {
        "rows": [
            {"kind": "sensor", "name": "tof", "wrong_ok": 0, **row},
            {"kind": "fault", "name": "frozen", "wrong_ok": 2, **row, "not_ok": {"the images repeat": 7}},
        ],
        "alarms": [{"test": "something moves", "frames": 1, "share": {"mean": 0.01, "interval": None}}],
    }
    monkeypatch.setattr(render, "read", lambda part: found)
    clean, faults = render.honesty_sensors(), render.honesty_faults()
    assert "| sensor | tof | 3 | 30 | 0 | 100.0 [50.0, 150.0] |" in clean and "| something moves | 1 | 1.00 |" in clean and "frozen" not in clean
    assert "the images repeat (7) |" in faults and "Cases with wrong `ok` frames: `frozen` (2)." in faults and "tof" not in faults
