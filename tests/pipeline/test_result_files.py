"""The JSON files of run folders, which may be a stranger's."""

import json
import os
import shutil

import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.record.writer import RecordingWriter
from trihedron.pipeline.run.result_files import read_results
from trihedron.pipeline.sweep.jobs import read_job

CURE = "run it again, or leave this folder out"
HOSTILE = {  # name -> text, cause
    "deep": ("[" * 100_000, "is not JSON (RecursionError)"),
    "not JSON": ("\0", "is not JSON (JSONDecodeError)"),
    "5000 digits": ('{"frames": ' + "9" * 5000 + "}", "is not JSON (ValueError)"),
    "a list": ("[1]", "holds a value that is not an object"),
    "null": ("null", "holds a value that is not an object"),
    "text for an object": ('{"final": "x"}', "holds 'final' that is not an object"),
    "text for a number": ('{"final": {"ate_rmse_m": "<script>"}}', "holds 'final.ate_rmse_m' of the wrong kind"),
    "true for a number": ('{"frames": true}', "holds 'frames' of the wrong kind"),
    "beyond a float": ('{"frames": ' + "9" * 400 + "}", "holds 'frames' of the wrong kind"),
    "a list for a stage": ('{"stages": {"\\u001b[31m": []}}', "holds 'stages.?[31m' that is not an object"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_no_result_is_one_line(tmp_path, name):
    text, cause = HOSTILE[name]
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(DataError) as error:
        read_results(tmp_path / "metrics.json")
    assert str(error.value) == f"{tmp_path}/metrics.json: {cause}; {CURE}"


def test_results_without_some_figures_are_read(tmp_path):
    assert read_results(tmp_path / "none.json") == {}
    found = {"frames": 3, "final": None, "status": {"ok": 3}, "stages": {"pose": {"p50_ms": 1.5}}, "other": [1]}
    (tmp_path / "metrics.json").write_text(json.dumps(found))
    assert read_results(tmp_path / "metrics.json") == found


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    words = ["dataset=synthetic", "dataset.width=160", "dataset.height=120", "dataset.length=4", f"out={folder}"]
    assert main(["run", *words]) == 0
    return folder


@pytest.mark.parametrize("file", ["metrics.json", "timing.json", ".hydra/overrides.yaml"])
@pytest.mark.parametrize("command", ["compare", "report", "site"])
def test_folders_of_strangers_are_no_tracebacks(tmp_path, capsys, run, command, file):
    """A run folder is data too: neither deep JSON, nor values of another kind, nor an alias bomb."""
    shutil.copytree(run, tmp_path / "run")
    levels = "".join(f"{b}: &{b} [{','.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi"))
    text = f"a: &a [x,x,x,x,x,x,x,x,x]\n{levels}" if file.endswith("yaml") else '{"final": "x", "frame_ms": []}'
    (tmp_path / "run" / file).write_text(text)
    out = [] if command == "compare" else ["--out", str(tmp_path / "out")]
    assert main([command, str(tmp_path / "run"), *out]) == 1
    line = capsys.readouterr().err
    assert line.startswith(f"trihedron: {tmp_path}/run/{file}: ") and line.count("\n") == 1 and len(line) < 500


def test_a_report_leaves_out_times_that_are_missing(tmp_path, run):
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "timing.json").write_text("{}")
    assert main(["report", str(tmp_path / "run"), "--out", str(tmp_path / "report.html")]) == 0


FILES = ["metrics.json", "timing.json", "job.json", ".hydra/overrides.yaml"]
CAUSES = {
    "empty": "is not ",
    "a list": "holds a value that is not an object",
    "binary": "is not a text file",
    "a pipe": "cannot be read (it is not a regular file)",
}


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("kind", CAUSES)
def test_a_run_that_cannot_be_read_is_left_out(tmp_path, capsys, run, kind, file):
    """As a crash leaves it, or as a stranger makes it: the others are compared all the same."""
    shutil.copytree(run, tmp_path / "runs" / "0")
    shutil.copytree(run, tmp_path / "runs" / "1")
    path = tmp_path / "runs" / "1" / file
    path.unlink(missing_ok=True)
    if kind == "a pipe":
        os.mkfifo(path)
    else:
        path.write_bytes({"empty": b"", "a list": b"[1]" if file.endswith("json") else b"{}", "binary": b"\xff\xfe"}[kind])
    assert main(["compare", str(tmp_path / "runs")]) == 0
    printed = capsys.readouterr()
    cause = "is not a list of words" if kind == "a list" and file.endswith("yaml") else CAUSES[kind]
    assert printed.err.startswith(f"trihedron: warning: {path}: {cause}") and printed.err.endswith("; this run is left out\n")
    assert printed.err.count("\n") == 1 and len(printed.out.splitlines()) == 2  # header and one run


@pytest.mark.parametrize("command", ["report", "site"])
def test_pages_of_runs_with_a_hostile_one(tmp_path, capsys, run, command):
    """Figures that are null, a configuration that is an alias bomb or has another shape, a deep list for the command."""
    for name in ("0", "1", "2"):
        shutil.copytree(run, tmp_path / "runs" / name)
    nulls = {"stages": {"pose": None}, "frame_ms": None, "own_memory_mb": None}
    (tmp_path / "runs" / "0" / "timing.json").write_text(json.dumps(nulls))
    levels = "".join(f"{b}: &{b} [{','.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi"))
    (tmp_path / "runs" / "1" / ".hydra" / "config.yaml").write_text(f"a: &a [x,x,x,x,x,x,x,x,x]\n{levels}")
    (tmp_path / "runs" / "2" / ".hydra" / "config.yaml").write_text("{dataset: [x], 1: {2: y}, graph: null}")
    writer = RecordingWriter(tmp_path / "runs" / "2" / "run.mcap", {"overrides": "[" * 100_000})
    writer.close()
    out = tmp_path / "out"
    assert main([command, str(tmp_path / "runs"), "--out", str(out)]) == 0, capsys.readouterr().err
    assert "Traceback" not in capsys.readouterr().err


def test_a_job_whose_state_was_cut_off_is_done_again(tmp_path):
    for text in ("", "[]", '{"state": 3}', "[" * 100_000):
        (tmp_path / "job.json").write_text(text)
        assert read_job(tmp_path) == {}


def test_a_folder_whose_name_is_not_utf_8_is_read_again(tmp_path):
    """File names are bytes; Python holds one that is no UTF-8 as a surrogate, which libyaml and UTF-8 refuse."""
    first, again = (os.fsdecode(os.fsencode(tmp_path) + name) for name in (b"/r\xff", b"/again\xff"))
    words = ["dataset=synthetic", "dataset.width=160", "dataset.height=120", "dataset.length=4"]
    assert main(["run", *words, f"out={first}"]) == 0
    assert main(["run", f"replay={first}/run.mcap", "only=[rotation]", f"out={again}"]) == 0
    assert main(["compare", first, again]) == 0
    assert main(["report", first, again, "--out", str(tmp_path / "report.html")]) == 0
    assert "r?" in (tmp_path / "report.html").read_text(encoding="utf-8")
