"""The JSON files of run folders, which may be a stranger's."""

import json
import shutil

import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.run.result_files import read_results

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
