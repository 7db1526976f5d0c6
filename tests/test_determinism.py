"""The same input and configuration give the same bytes on every topic but `/timing`: for any number of threads, again, elsewhere, under load."""

import contextlib
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from trihedron.pipeline.app.cli import main

sys.path.insert(0, str(Path(__file__).parent / "pipeline"))
from toys import contents

SMALL = ["dataset.width=160", "dataset.height=120", "outputs=[trajectory,surface]"]
RUN = "import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(['run', *sys.argv[1:]]))"


@contextlib.contextmanager
def load(processes):
    """Other programs that want the processors too, as long as this one lives."""
    wait = f"import os\nwhile os.getppid() == {os.getpid()}: pass"
    busy = [subprocess.Popen([sys.executable, "-c", wait]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def differing(one, other):
    return sorted(channel for channel in one.keys() | other.keys() if one.get(channel) != other.get(channel))


def test_threads_load_and_the_place_change_no_byte(tmp_path, monkeypatch):
    """In one process, so that what an earlier run left behind would show too."""
    words = ["run", *SMALL, "dataset.length=14"]
    assert main([*words, "threads=1", f"out={tmp_path}/first"]) == 0
    first = contents(tmp_path / "first" / "run.mcap")
    assert {"/pose", "/map", "/keypoints", "/surface", "/view/pose"} <= set(first) and len(first["/pose"]) == 14
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    with load(1):
        for threads in (2, 4):
            assert main([*words, f"threads={threads}", f"out={threads}"]) == 0
            assert differing(first, contents(f"{threads}/run.mcap")) == []
    assert main([*words, "dataset.seed=1", "threads=2", "out=other"]) == 0  # the comparison can fail
    assert {"/pose", "/map", "/keypoints"} <= set(differing(first, contents("other/run.mcap")))


@pytest.mark.slow
def test_ten_runs_in_processes_of_their_own_are_one(tmp_path):
    """1, 2 and 4 threads, every other one under load, each from a folder of its own with another seed of Python's hashes, over a loss and back."""
    words = ["dataset=faults", "+dataset.options.width=320", "+dataset.options.height=240", "dataset.frames=0:90", "dataset.cover=40:50"]
    first = None
    for number in range(10):
        folder = tmp_path / str(number)
        folder.mkdir()
        environment = {**os.environ, "PYTHONHASHSEED": str(number)}
        with load(2 * (number % 2)):
            command = [sys.executable, "-c", RUN, *words, f"threads={(1, 2, 4)[number % 3]}", "out=run"]
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-1000:]
        found = contents(folder / "run" / "run.mcap")
        first = first or found
        assert differing(first, found) == [], number
        for name in ("trajectory.txt", "trajectory_causal.txt", "metrics.json"):
            assert (folder / "run" / name).read_bytes() == (tmp_path / "0" / "run" / name).read_bytes()


PROCESSORS = [
    {"OPENBLAS_CORETYPE": "Haswell"},
    {"OPENBLAS_CORETYPE": "SkylakeX"},
    {"OPENBLAS_CORETYPE": "Zen"},
    {"OPENBLAS_CORETYPE": "Prescott"},
    {"NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4"},
    {"NUMBA_CPU_NAME": "generic"},  # compiles every kernel
]


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the kernels of x86-64 are selected")
@pytest.mark.parametrize("environment", PROCESSORS, ids=lambda environment: " ".join(environment.values()))
def test_other_processors_give_the_same_bytes(tmp_path, environment):
    """Libraries select their code by the processor; these variables make them select that of another one."""
    words = ["dataset=synthetic", "dataset.length=4", "dataset.width=320", "dataset.height=240", "outputs=[trajectory,surface]"]
    for name, changes in (("here", {}), ("there", environment)):
        program = [sys.executable, "-c", RUN, *words, f"out={tmp_path / name}"]
        subprocess.run(program, check=True, capture_output=True, env={**os.environ, **changes})
    assert main(["diff", str(tmp_path / "here" / "run.mcap"), str(tmp_path / "there" / "run.mcap")]) == 0
