"""Sweeps on a cluster: the same jobs, progress, reasons and resumption as here, by submitit and by a Dask scheduler."""

import getpass
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
import yaml

from trihedron.pipeline.app.cli import main

SLURM = """
ClusterName=here
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
NodeName=here NodeAddr=127.0.0.1 NodeHostname={host} CPUs={cpus}
PartitionName=cpu Nodes=here Default=YES
"""
QUICK = ["dataset.width=64", "dataset.height=48", "dataset.length=4", "outputs=[keypoints]"]


def threads_of(folder):
    return yaml.safe_load((folder / ".hydra" / "config.yaml").read_text())["threads"]


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """The address of a Dask scheduler with one worker, on the loopback interface."""
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
    assert "seed: -1 is negative" in said and "sweep: 1 of 2 jobs done, 1 failed, " in said and "1 of 2 jobs failed" in said
    assert threads_of(tmp_path / "sweep" / "0") == 1
    before = (tmp_path / "sweep" / "0" / "run.mcap").stat().st_mtime_ns
    assert main([*words, "seed=0,1"]) == 0
    assert "sweep: 1 of 2 jobs are done already" in capfd.readouterr().err
    assert (tmp_path / "sweep" / "0" / "run.mcap").stat().st_mtime_ns == before


@pytest.mark.slow
def test_submitit_runs_the_jobs_as_it_would_on_slurm(tmp_path, capfd):
    words = ["run", "-m", *QUICK, "hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=2", f"out={tmp_path}"]
    assert main([*words, "seed=0,-1"]) == 1
    said = capfd.readouterr().err
    assert "seed: -1 is negative" in said and "sweep: 1 of 2 jobs done, 1 failed, " in said
    assert json.loads((tmp_path / "0" / "job.json").read_text())["state"] == "done" and threads_of(tmp_path / "0") == 2


def kill_one(program, folder):
    """The first process that runs `program` in the folder, or with it among its words."""
    until = time.monotonic() + 120
    while time.monotonic() < until:
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                words = (process / "cmdline").read_text()
                if program in words and (str(folder) in words or (process / "cwd").resolve() == folder):
                    return os.kill(int(process.name), signal.SIGKILL)
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["submitit", "dask"])
def test_a_job_whose_process_dies_is_waited_for_by_no_other_and_stops_none(engine, request, tmp_path, capfd, monkeypatch):
    """It dies before it could say anything, and has its row."""
    monkeypatch.chdir(tmp_path)
    if engine == "dask":
        program, cause = "trihedron.pipeline.sweep.cluster", "the job's process ended with -9"
        launcher = ["hydra/launcher=dask", f"hydra.launcher.address={request.getfixturevalue('scheduler')}"]
    else:
        program, cause = "submitit.core._submit", "its process died; it crashed, or memory ran out"
        launcher = ["hydra/launcher=submitit_local"]
    killer = threading.Thread(target=kill_one, args=(program, tmp_path))
    killer.start()
    assert main(["run", "-m", *QUICK, *launcher, f"out={tmp_path}", "seed=0,1"]) == 1
    killer.join()
    assert "1 of 2 jobs failed" in capfd.readouterr().err
    said = sorted(json.loads((tmp_path / name / "job.json").read_text())["state"] for name in "01")
    assert said == ["done", "failed"]
    main(["compare", str(tmp_path)])
    assert cause in capfd.readouterr().out


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    """The folder of a SLURM of this machine alone, on the loopback interface: its own key, controller and one node."""
    programs = [shutil.which(name, path=os.environ["PATH"] + ":/usr/sbin") for name in ("munged", "slurmctld", "slurmd", "sbatch")]
    if not all(programs):
        pytest.skip("needs SLURM: apt-get install slurm-wlm munge")
    munged, controller, node, _ = programs
    folder = tmp_path_factory.mktemp("slurm")
    (folder / "key").write_bytes(os.urandom(64))
    (folder / "key").chmod(0o600)
    ports = [free_port(), free_port()]
    machine = {"user": getpass.getuser(), "host": socket.gethostname(), "cpus": os.cpu_count()}
    (folder / "slurm.conf").write_text(SLURM.format(folder=folder, ports=ports, **machine))
    environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
    key = [f"--socket={folder}/munge", f"--key-file={folder}/key", f"--pid-file={folder}/munged.pid", f"--seed-file={folder}/seed"]
    ours = []
    with (folder / "log").open("w") as log:
        for words in ([munged, "--foreground", "--force", *key], [controller, "-D"], [node, "-D", "-N", "here"]):
            ours.append(subprocess.Popen(words, stdout=log, stderr=log, env=environment))
            time.sleep(1.0)  # the others ask it when they begin

        def said(*words, wanted):
            """Ask until the answer is the wanted one."""
            until = time.monotonic() + 60
            while (answer := subprocess.run(words, env=environment, capture_output=True, text=True).stdout.strip()) != wanted:
                assert time.monotonic() < until, (answer, (folder / "log").read_text()[-2000:])
                time.sleep(0.5)

        said("sinfo", "-h", "-o", "%t", wanted="idle")
        yield folder
        said("squeue", "-h", wanted="")  # a step that outlives its controller waits for it
        for process in reversed(ours):
            process.terminate()
            process.wait(60)


@pytest.mark.slow
def test_slurm_runs_what_is_missing_and_a_job_that_fails_stops_no_other(slurm, tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("SLURM_CONF", str(slurm / "slurm.conf"))
    asked = ["hydra.launcher.partition=cpu", "hydra.launcher.cpus_per_task=1"]
    words = ["run", "-m", *QUICK, "hydra/launcher=submitit_slurm", *asked, f"out={tmp_path}"]
    assert main([*words, "seed=0,-1"]) == 1
    said = capfd.readouterr().err
    assert "seed: -1 is negative" in said and "sweep: 1 of 2 jobs done, 1 failed, " in said and "1 of 2 jobs failed" in said
    [batch] = tmp_path.glob(".submitit/*/*_submission.sh")
    assert "#SBATCH --partition=cpu" in batch.read_text() and "#SBATCH --array=0-1" in batch.read_text()
    assert threads_of(tmp_path / "0") == 1
    before = (tmp_path / "0" / "run.mcap").stat().st_mtime_ns
    assert main([*words, "seed=0,1"]) == 0
    assert "sweep: 1 of 2 jobs are done already" in capfd.readouterr().err
    assert (tmp_path / "0" / "run.mcap").stat().st_mtime_ns == before


@pytest.mark.parametrize(
    "address, said",
    [
        ("", "trihedron: hydra.launcher.address: is not given; give hydra.launcher.address=tcp://HOST:8786"),
        ("tcp://127.0.0.1:9", "trihedron: hydra.launcher.address: no Dask scheduler answers at tcp://127.0.0.1:9; start `dask scheduler`"),
        ("far away", "trihedron: hydra.launcher.address: no Dask scheduler answers at far away; start"),
    ],
)
def test_a_wrong_address_is_one_line(address, said, tmp_path, capfd):
    assert main(["run", "-m", *QUICK, "hydra/launcher=dask", f"hydra.launcher.address={address}", f"out={tmp_path}"]) == 1
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith(said)
