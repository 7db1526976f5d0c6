"""Sweeps: keys of jobs, data sets by a word, what is done already is not done again, and a job that fails stops no other."""

import io
import json
import os
import subprocess
import sys
from contextlib import redirect_stderr

import pytest
import yaml
from hydra import compose, initialize_config_module

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.config import compose_run, register_configs
from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.overrides import list_elements
from trihedron.pipeline.core.registry import load_plugins
from trihedron.pipeline.sweep.jobs import key_of, write_job
from trihedron.pipeline.sweep.progress import Progress
from trihedron.pipeline.sweep.sweep import alternatives_on, words_of_sequence
from trihedron.tools.benchmark import PROGRAM

QUICK = ["dataset.width=64", "dataset.height=48", "dataset.length=4", "outputs=[keypoints]"]


def key(*overrides):
    load_plugins()
    register_configs()
    with initialize_config_module("trihedron.conf", version_base="1.3"):
        return key_of(compose("root", overrides=list(overrides)))


def test_a_key_is_of_what_is_computed(tmp_path):
    assert key("out=a", "report=compare") == key("out=b")
    assert key("seed=1") != key("seed=0") != key("seed=0", "keypoints.features=300")


def test_a_key_is_of_the_files_that_are_read(tmp_path):
    (tmp_path / "rgb").mkdir()
    image = tmp_path / "rgb" / "0.png"
    image.write_bytes(b"an image")
    words = ("dataset=tum", f"dataset.path={tmp_path}")
    first = key(*words)
    assert key(*words) == first
    from trihedron.pipeline.sweep import jobs

    jobs._files.cache_clear()  # of one sweep
    os.utime(image, ns=(1, 1))
    assert key(*words) != first


@pytest.mark.parametrize(
    "text, words",
    [
        ("synthetic", ["dataset=synthetic"]),
        ("tum:/data/desk frames=0:9", ["dataset=tum", "dataset.path=/data/desk", "dataset.frames=0:9"]),
        ("faults of=tum options.path=/data", ["dataset=faults", "dataset.of=tum", "+dataset.options.path=/data"]),
        ("synthetic length=9 without=loop pose.x=1 alternatives=a,b", ["dataset=synthetic", "dataset.length=9", "without=loop", "pose.x=1"]),
        ("tum:/my data/it's [1], a frames=0:9", ["dataset=tum", r"dataset.path='/my data/it\'s [1], a'", "dataset.frames=0:9"]),
    ],
)
def test_a_word_is_a_data_set(text, words):
    assert words_of_sequence(text) == words


def test_a_sequence_chooses_its_alternatives():
    alternatives = [[], ["lines=lsd"], ["model=tsdf", "pose=icp"], ["graph=points"]]
    assert alternatives_on("synthetic", alternatives) == alternatives
    assert alternatives_on("synthetic alternatives=model,graph length=9", alternatives) == [[], ["model=tsdf", "pose=icp"], ["graph=points"]]
    assert alternatives_on("synthetic alternatives=planes", alternatives) == []
    with pytest.raises(UsageError, match="begins with 'plane='; did you mean 'planes'"):
        alternatives_on("synthetic alternatives=plane", alternatives)


def test_a_folder_with_blanks_and_equal_signs_is_the_longest_that_exists(tmp_path):
    folder = tmp_path / "a b=c d"
    folder.mkdir()
    assert words_of_sequence(f"tum:{folder} frames=0:9") == ["dataset=tum", f"dataset.path='{folder}'", "dataset.frames=0:9"]
    assert words_of_sequence(f"tum:{folder} e=f")[1:] == [f"dataset.path='{folder}'", "dataset.e=f"]


@pytest.mark.parametrize("text, elements", [
    ('["tum:/data/desk frames=0:300",synthetic]', ["tum:/data/desk frames=0:300", "synthetic"]),
    ("[tum:/a b, 'tum:/c,d' ,\"tum:/e'f\"]", ["tum:/a b", "tum:/c,d", "tum:/e'f"]),
    (r"['it\'s',tum:/x[1](2)]", ["it's", "tum:/x[1](2)"]),
    ("[]", []),
])  # fmt: skip
def test_a_list_of_data_sets_is_taken_literally(text, elements):
    assert list_elements(text) == elements
    assert list(compose_run([f"sequences={text}"]).sequences) == elements


ALL_AT_ONCE = 'it\'s "b" [1] (2) {3},a=b #1 größe'
NAMES = ["with blanks", "it's", 'a "b"', "[1] (2) {3}", "a,b", "a=b", "#1", "größe"]


@pytest.mark.parametrize("name", [ALL_AT_ONCE, *(pytest.param(name, marks=pytest.mark.slow) for name in NAMES)])
def test_any_folder_can_be_swept(tmp_path, name):
    folder = tmp_path / name
    assert main(["run", *QUICK, "record.frames=true", f"out={folder}"]) == 0
    element = f"mcap:{folder}/run.mcap".replace('"', r"\"")
    words = ["run", "-m", "hydra/launcher=basic", "outputs=[keypoints]", f'sequences=["{element}"]', f"out={folder}/sweep"]
    assert main(words) == 0
    assert yaml.safe_load((folder / "sweep" / "0" / ".hydra" / "config.yaml").read_text())["dataset"]["path"] == f"{folder}/run.mcap"


def test_a_dry_run_lists_jobs_and_what_they_share_and_runs_nothing(tmp_path, capfd):
    folder, words = tmp_path / "sweep", ["run", "-m", *QUICK[:-1], "outputs=[manhattan]", "manhattan=mean_shift,plane_svd"]
    assert main([*words, "normals.patch_px=8,10,999", "--dry-run", f"out={folder}"]) == 0
    said = capfd.readouterr().out.splitlines()
    assert not folder.exists()
    assert said[0].split() == ["job", "state", "change", "stages", "shared", "with", "other", "jobs"]
    rows = {line.split()[0]: line for line in said[1:7]}
    assert "manhattan=mean_shift normals.patch_px=8 " in rows["0"] and rows["0"].endswith("dataset, normals, lines, segments, planes")
    assert rows["3"].endswith("  dataset, normals, planes") and "refused" in rows["5"] and "normals.patch_px: 999 is not" in rows["5"]
    assert said[7] == "6 jobs: 4 to run, 2 refused" and said[8].startswith("20 stages, 11 of them different")
    assert said[9] == f"words of all jobs: {' '.join(QUICK[:-1])} outputs=[manhattan] out={folder} threads=1"


def test_a_live_table_shows_what_runs_what_ended_and_why_one_failed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    folders = [tmp_path / name for name in "0123"]
    progress = Progress(folders, ["seed=0", "seed=1", "seed=2", "seed=3"], 2, 6)
    write_job(folders[0], "", "done")
    (folders[0] / "metrics.json").write_text(json.dumps({"final": {"ate_rmse_m": 0.00123}}))
    write_job(folders[1], "", "running")
    with progress:
        pass
    first = capsys.readouterr().err
    assert first.splitlines()[0].startswith("sweep: 3 of 6 jobs done, 3 left, 0 s, about ") and first.splitlines()[0].endswith(" left")
    assert [line.split() for line in first.splitlines()[1:]] == [
        ["1", "running", "0", "s", "seed=1"],
        ["0", "done", "0", "s", "ATE", "1.23", "mm", "seed=0"],
    ]
    write_job(folders[1], "", "failed", "planes: no plane")
    progress.__exit__()
    second = capsys.readouterr().err
    assert second.startswith("\x1b[3F\x1b[Jtrihedron: job 1: planes: no plane\nsweep: 3 of 6 jobs done, 1 failed, 2 left, ") and "1  failed" in second


def test_progress_goes_to_the_terminal_while_a_job_redirects_its_errors(tmp_path, capsys):
    progress = Progress([tmp_path], [""], 0, 1)
    with redirect_stderr(io.StringIO()) as log:
        progress.__enter__()
        write_job(tmp_path, "", "failed", "planes: no plane")
        progress.__exit__()
    assert log.getvalue() == ""
    assert capsys.readouterr().err.splitlines()[0] == f"trihedron: job {tmp_path.name}: planes: no plane"


def test_a_live_table_has_median_and_interval_of_repeats(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    changes = [f"manhattan={name} dataset.seed={seed}" for name in ("mean_shift", "mixture") for seed in range(3)]
    folders = [tmp_path / str(number) for number in range(6)]
    for folder, ate_mm in zip(folders, (1.0, 2.0, 6.0, 4.0)):
        write_job(folder, "", "done")
        (folder / "metrics.json").write_text(json.dumps({"final": {"ate_rmse_m": 1e-3 * ate_mm}}))
    write_job(folders[5], "", "running")
    with Progress(folders, changes, 1, 9, failed=1):  # four of the six were done before
        pass
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "sweep: 5 of 9 jobs done, 1 failed, 3 left, 0 s",
        "  5  running  0 s    manhattan=mixture dataset.seed=2",
        "  3 seeds: ATE median 2.00 mm, mean 3.00 ± 6.57 (95 %)  manhattan=mean_shift",  # 4.3027 standard errors of 1.5275
    ]


def test_a_sweep_goes_on_where_it_was_stopped(tmp_path, capfd):
    words = ["run", "-m", *QUICK, 'sequences=["synthetic","synthetic texture=false"]', f"out={tmp_path}", "seed=0"]
    assert main(words) == 0
    said = capfd.readouterr()
    assert "sweep: 2 of 2 jobs done" in said.err
    assert "p50 ms" in said.out and said.out.splitlines()[-1] == f"next: trihedron report {tmp_path} draws the runs of this table"
    before = [(tmp_path / job / "run.mcap").stat().st_mtime_ns for job in ("0", "1")]
    assert main([*words, "--dry-run"]) == 0
    assert "2 jobs: 2 done" in capfd.readouterr().out.splitlines()
    assert json.loads((tmp_path / "1" / "job.json").read_text())["state"] == "done"
    assert "texture=False" in (tmp_path / "1" / ".hydra" / "overrides.yaml").read_text()
    assert "threads: 1" in (tmp_path / "1" / ".hydra" / "config.yaml").read_text()
    (tmp_path / "0" / "job.json").write_text(json.dumps({"key": "", "state": "running", "error": ""}))  # as one that was killed leaves it
    more = [*words[:-1], "seed=0,9:0"]
    assert main(more) == 1
    said = capfd.readouterr().err
    assert "sweep: 1 of 4 jobs are done already" in said and "2 of 4 jobs failed" in said
    after = [(tmp_path / job / "run.mcap").stat().st_mtime_ns for job in ("0", "1")]
    assert after[0] > before[0] and after[1] == before[1]
    assert main(["compare", str(tmp_path)]) == 0
    assert capfd.readouterr().out.count("9:0") >= 2


KILLED = """
import os, signal
from dataclasses import dataclass
from trihedron.pipeline.core.registry import register
from trihedron.pipeline.core.types import Frame, Keypoints

@register("keypoints", "killed")
@dataclass(frozen=True)
class Killed:
    def __call__(self, frame: Frame) -> Keypoints:
        os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_job_whose_process_dies_fails_alone(tmp_path):
    (tmp_path / "killed.py").write_text(KILLED)
    about = tmp_path / "killed-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Name: killed\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[trihedron.plugins]\nkilled = killed\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    words = ["run", "-m", *QUICK, "keypoints=orb,killed,none", "seed=0,1", f"out={tmp_path / 'sweep'}"]
    done = subprocess.run([*PROGRAM, *words], env=environment, capture_output=True, text=True)
    assert done.returncode == 1 and "2 of 6 jobs failed" in done.stderr and "sweep: 4 of 6 jobs done, 2 failed, " in done.stderr, done.stderr
    jobs = [json.loads((tmp_path / "sweep" / str(number) / "job.json").read_text()) for number in range(6)]
    assert [job["state"] for job in jobs] == ["done", "done", "failed", "failed", "done", "done"]
    assert jobs[2]["error"] == f"{tmp_path / 'sweep' / '2'}: its process died; it crashed, or memory ran out"


def test_hydras_own_word_for_a_sweep_sweeps_as_well(tmp_path, capfd):
    words = ["run", "hydra.mode=MULTIRUN", "hydra/launcher=basic", *QUICK, "graph.keypoints.frame=nothing", f"out={tmp_path}"]
    assert main(words) == 1
    assert "1 of 1 jobs failed" in capfd.readouterr().err


def test_a_single_run_imports_no_engine_of_sweeps(tmp_path):
    program = f"from trihedron.pipeline.app.cli import main; main(['run', 'graph=structurel', 'out={tmp_path}']); import sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert "hydra" in loaded and not {"joblib", "trihedron.pipeline.sweep.sweep"} & set(loaded)
