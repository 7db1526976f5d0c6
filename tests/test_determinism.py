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
OFFICE = Path(__file__).resolve().parents[2] / "shared" / "data" / "icl_office_rendered"
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
    words = ["run", *SMALL, "dataset.length=9"]
    assert main([*words, "threads=1", f"out={tmp_path}/first"]) == 0
    first = contents(tmp_path / "first" / "run.mcap")
    assert {"/pose", "/map", "/keypoints", "/surface", "/view/pose"} <= set(first) and len(first["/pose"]) == 9
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for threads, busy in ((2, 0), (4, 1)):
        with load(busy):
            assert main([*words, f"threads={threads}", f"out={threads}"]) == 0
        assert differing(first, contents(f"{threads}/run.mcap")) == []
    assert main([*words, "dataset.noise=false", "threads=2", "out=other"]) == 0  # the comparison can fail
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


# It draws no plot: matplotlib calls LAPACK, and a machine without AVX-512 ends a program that calls SkylakeX's.
PROGRAM = """
import sys
import {first}
from trihedron.pipeline.app.cli import main
from trihedron.pipeline.app import execute
execute.trajectory_figure = lambda *arguments, **options: None
sys.exit(main(["run", *sys.argv[1:]]))
"""
PROCESSORS = [
    ("numpy", {"OPENBLAS_CORETYPE": "SkylakeX", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4"}),
    ("trihedron", {"OPENBLAS_CORETYPE": "Haswell"}),
    ("numpy", {"OPENBLAS_CORETYPE": "Zen"}),
    ("numpy", {"OPENBLAS_CORETYPE": "Prescott"}),
]
GENERIC = ("numpy", {"NUMBA_CPU_NAME": "generic"})  # compiles every kernel
ON_X86 = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the code of x86-64 processors is selected")


def recorded(folder, words, first, environment):
    """Topics of a run in a process of its own, that imports `first` before everything else."""
    command = [sys.executable, "-c", PROGRAM.format(first=first), *words, f"out={folder}"]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})
    assert done.returncode == 0, f"{environment}: exit code {done.returncode}, {done.stderr[-1000:]}"
    return contents(folder / "run.mcap")


def check_processors(tmp_path, words, processors):
    assert main(["run", *words, f"out={tmp_path}/here"]) == 0
    here = contents(tmp_path / "here" / "run.mcap")
    assert {"/keypoints", "/planes", "/manhattan", "/pose", "/map"} <= set(here)
    for k, (first, environment) in enumerate(processors):
        assert differing(here, recorded(tmp_path / str(k), words, first, environment)) == [], environment


@ON_X86
def test_processors_and_the_order_of_imports_change_no_byte(tmp_path):
    """No topic depends on BLAS or LAPACK: the variables make OpenBLAS and NumPy select the code of another processor."""
    check_processors(tmp_path, ["dataset=synthetic", "dataset.length=4", "dataset.width=160", "dataset.height=120"], PROCESSORS[:1])


@ON_X86
@pytest.mark.slow
@pytest.mark.skipif(not OFFICE.is_dir(), reason="the rendered office is not beside this folder")
def test_processors_change_no_byte_of_the_office(tmp_path):
    words = ["dataset=tum", f"dataset.path={OFFICE}", "dataset.frames=0:500"]
    check_processors(tmp_path, words, PROCESSORS)


@ON_X86
@pytest.mark.slow
def test_a_generic_processor_and_surfaces(tmp_path):
    words = ["dataset=synthetic", "dataset.length=4", "dataset.width=320", "dataset.height=240", "outputs=[trajectory,surface]"]
    check_processors(tmp_path, words, [*PROCESSORS, GENERIC])


def test_the_import_changes_nothing_of_the_process():
    """Libraries that are imported with the classes set variables of their own: OpenCV's wheel and threadpoolctl."""
    code = "import os; before = dict(os.environ); import trihedron; assert dict(os.environ) == before; trihedron.Slam; "
    code += "changed = {name for name, value in os.environ.items() if before.get(name) != value}; "
    code += "assert changed <= {'LD_LIBRARY_PATH', 'KMP_DUPLICATE_LIB_OK'}, changed"
    subprocess.run([sys.executable, "-c", code], check=True)
