"""Sweeps on a cluster: the same jobs, progress, reasons and resumption as here, by submitit and by a Dask scheduler."""

import json
import subprocess
import sys
import time

import pytest
import yaml

from trihedron.pipeline.cli import main

QUICK = ["dataset.width=64", "dataset.height=48", "dataset.length=4", "outputs=[keypoints]"]


def threads_of(folder):
    return yaml.safe_load((folder / ".hydra" / "config.yaml").read_text())["threads"]


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """The address of a Dask scheduler with one worker, on the loopback interface."""
    pytest.importorskip("distributed", reason="needs trihedron[cluster]")
    folder = tmp_path_factory.mktemp("dask")
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder}
    file = folder / "scheduler.json"
    ours = [subprocess.Popen([*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)], **quiet)]
    worker = [*dask, "worker", "--scheduler-file", str(file), "--nthreads", "2", "--no-dashboard", "--host", "127.0.0.1"]
    ours.append(subprocess.Popen(worker, **quiet))
    until = time.monotonic() + 120
    while not file.exists() and time.monotonic() < until:
        time.sleep(0.1)
    yield json.loads(file.read_text())["address"]
    for process in reversed(ours):
        process.terminate()
        process.wait(60)


@pytest.mark.slow
def test_a_dask_scheduler_runs_what_is_missing_and_a_job_that_fails_stops_no_other(scheduler, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)  # which the worker is not in
    words = ["run", "-m", *QUICK, "hydra/launcher=dask", f"hydra.launcher.address={scheduler}", "out=sweep"]
    assert main([*words, "seed=0,-1"]) == 1
    said = capfd.readouterr().err
    assert "seed: -1 is negative" in said and "sweep: 2 of 2 jobs done" in said and "1 of 2 jobs failed" in said
    assert threads_of(tmp_path / "sweep" / "0") == 1
    before = (tmp_path / "sweep" / "0" / "run.mcap").stat().st_mtime_ns
    assert main([*words, "seed=0,1"]) == 0
    assert "sweep: 1 of 2 jobs are done already" in capfd.readouterr().err
    assert (tmp_path / "sweep" / "0" / "run.mcap").stat().st_mtime_ns == before


@pytest.mark.slow
def test_submitit_runs_the_jobs_as_it_would_on_slurm(tmp_path, capfd):
    pytest.importorskip("submitit", reason="needs trihedron[cluster]")
    words = ["run", "-m", *QUICK, "hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=2", f"out={tmp_path}"]
    assert main([*words, "seed=0,-1"]) == 1
    said = capfd.readouterr().err
    assert "seed: -1 is negative" in said and "sweep: 2 of 2 jobs done" in said
    assert json.loads((tmp_path / "0" / "job.json").read_text())["state"] == "done" and threads_of(tmp_path / "0") == 2


@pytest.mark.parametrize(
    "address, said",
    [
        ("", "trihedron: hydra.launcher.address: is not given; give hydra.launcher.address=tcp://HOST:8786"),
        ("tcp://127.0.0.1:9", "trihedron: hydra.launcher.address: no Dask scheduler answers at tcp://127.0.0.1:9; start `dask scheduler`"),
        ("far away", "trihedron: hydra.launcher.address: no Dask scheduler answers at far away; start"),
    ],
)
def test_a_wrong_address_is_one_line(address, said, tmp_path, capfd):
    pytest.importorskip("distributed", reason="needs trihedron[cluster]")
    assert main(["run", "-m", *QUICK, "hydra/launcher=dask", f"hydra.launcher.address={address}", f"out={tmp_path}"]) == 1
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith(said)
