"""What the default graph compiles is listed, so that other cores can do it."""

import importlib
import json
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import pytest
from numba import typeof, types

from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline.run import kernels
from trihedron.pipeline.run.kernels import LISTED, type_of, word_of
from trihedron.plugins.shared.pose_optimizer_kernels import Flags
from trihedron.tools.compile import RUNS

ENTRIES = json.loads(LISTED.read_text())


@pytest.mark.parametrize("entry", ENTRIES, ids=[f"{kernel.split(':')[1]}-{row}" for row, (kernel, _) in enumerate(ENTRIES)])
def test_what_is_listed_is_a_kernel_and_takes_so_many_arguments(entry):
    kernel, arguments = entry
    module, name = kernel.split(":")
    function = getattr(importlib.import_module(module), name)
    assert function.py_func.__code__.co_argcount >= len(arguments)
    assert [word_of(type_of(word)) for word in arguments] == arguments


def test_types_come_back_from_their_words():
    frozen = np.zeros((2, 3), np.float32)
    frozen.flags.writeable = False
    flags = Flags(*(np.zeros(2, np.uint8) for _ in range(3)))
    for value, word in (
        (frozen, "readonly float32[2C]"),
        (np.zeros((2, 3)).T, "float64[2F]"),
        (np.zeros(4, bool), "bool[1C]"),
        (True, "bool"),
        ((1, 2.0), ["int64", "float64"]),
        (flags, {"trihedron.plugins.shared.pose_optimizer_kernels:Flags": ["uint8[1C]"] * 3}),
        (np.zeros((2, 3), [("n", "f8"), ("z", "f4")]), {"[2C]": [["n", "<f8"], ["z", "<f4"]]}),
    ):
        assert word_of(typeof(value)) == word and type_of(word) == typeof(value), word


def test_the_longest_are_listed_first_and_others_kernels_never():
    called = kernels.Called()
    called.kernels = {("trihedron.x:short", (types.int64,)): 1.0, ("numba.x:y", (types.int64,)): 9.0, ("trihedron.x:long", (types.float64,)): 2.0}
    called.kernels["trihedron.x:text", (types.unicode_type,)] = 9.0
    assert kernels.listed(called) == [["trihedron.x:long", ["float64"]], ["trihedron.x:short", ["int64"]]]


def test_what_is_called_is_what_the_interpreter_calls():
    @numba.njit
    def inner(x):
        return x + 1

    @numba.njit
    def outer(x):
        return inner(x) + 1

    with kernels.Called() as called:
        assert outer(1) == 3 and outer(2) == 4
        assert len(called.kernels) == 1 and min(called.kernels.values()) > 0.0
        assert inner(1) == 2  # which was a part before
        assert len(called.kernels) == 2
    assert outer(1.0) == 3.0 and len(called.kernels) == 2


def test_a_graph_uses_the_modules_that_its_plugins_take_something_from():
    used = kernels.used_by([Synthetic()])
    assert "trihedron.datasets.simulation.raytracing" in used
    assert "trihedron.plugins.planes.common" not in used


def test_a_plugin_whose_module_only_another_process_knows_uses_what_can_be_seen():
    unknown = type("Sent", (), {"__module__": "nowhere.to_be_found"})()
    assert "trihedron.datasets.simulation.raytracing" in kernels.used_by([unknown, Synthetic()])


PROGRAM = """
import json, sys
import numpy as np
from trihedron.datasets.simulation.synthetic import Synthetic
from trihedron.pipeline import kernels
from trihedron.plugins.numerics.axes.sphere_modes import orthonormal

names = ("sphere_modes:orthonormal", "sphere_modes:search_axes")
rows = [row for row, (kernel, _) in enumerate(json.loads(kernels.LISTED.read_text())) if kernel.endswith(names)]
modules = {"trihedron.plugins.manhattan.common"}
before = kernels.missing(modules)
if sys.argv[1] == "ahead":
    kernels.cores = lambda: 1
    with kernels.Compilation(rows) as compilation:
        assert list(compilation) == rows
    assert set(before) - set(kernels.missing(modules)) == set(rows)
print(orthonormal(np.arange(9.0).reshape(3, 3) ** 2 % 7, np.ones(3)).tolist())
"""

TIMED = """
import json, sys, time
import numpy as np
from trihedron.pipeline import kernels
from trihedron.plugins.normals.integral_image import IntegralImage
from trihedron.datasets.simulation.synthetic import Synthetic

if sys.argv[1] == "ahead":
    kernels.cores = lambda: 1
    with kernels.Compilation([row for row, (kernel, _) in enumerate(json.loads(kernels.LISTED.read_text())) if "patch_normals" in kernel]) as ahead:
        list(ahead)
frame, plugin, ms = Synthetic(texture=False)(0), IntegralImage(), []
for _ in range(60):
    began = time.thread_time()
    plugin(frame)
    ms.append(1e3 * (time.thread_time() - began))
print(min(ms))
"""


@pytest.fixture
def listed_kernel(tmp_path, monkeypatch):
    """A kernel that no process has compiled yet, in the list's only row."""
    (tmp_path / "halves.py").write_text("import numba\n\n\n@numba.njit(cache=True)\ndef half(x):\n    return 0.5 * x\n")
    (tmp_path / "kernels.json").write_text('[["halves:half", ["float64"]]]')
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(kernels, "LISTED", tmp_path / "kernels.json")
    yield importlib.import_module("halves").half
    del sys.modules["halves"]


def test_a_call_waits_for_what_is_compiled_elsewhere_and_is_told_for_how_long(listed_kernel):
    with kernels.Awaited([0]) as awaited, ThreadPoolExecutor() as others:
        answer = others.submit(listed_kernel, 3.0)
        with pytest.raises(TimeoutError):
            answer.result(0.3)
        awaited.done(0)
        assert answer.result(60.0) == 1.5 and awaited.seconds > 0.25
    assert kernels.DISPATCHER._compile_for_args.__name__ == "_compile_for_args"


def test_where_nothing_more_is_compiled_the_call_compiles(listed_kernel):
    with kernels.Awaited([0]) as awaited:
        awaited.end()
        assert listed_kernel(3.0) == 1.5 and awaited.seconds == 0.0


def test_ctrl_c_ends_the_waiting(listed_kernel, monkeypatch):
    with kernels.Awaited([0]), ThreadPoolExecutor() as others:
        answer = others.submit(listed_kernel, 3.0)
        time.sleep(0.1)
        monkeypatch.setattr(kernels.Interrupts, "count", kernels.Interrupts.count + 1)
        assert isinstance(answer.exception(5.0), KeyboardInterrupt)


def test_what_is_given_up_ends():
    with kernels.Compilation([0]) as compilation:
        compilation.give_up()
        assert list(compilation) == []


@pytest.mark.slow
def test_the_first_frame_does_not_wait_for_what_later_ones_need(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    program = [sys.executable, "-c", "import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(sys.argv[1:]))", "run"]
    words = ["dataset.width=160", "dataset.height=120", "outputs=[trajectory]"]
    said = []
    for number, frames in enumerate(("0:1", "0:20", "0:20")):
        run = subprocess.run([*program, *words, f"dataset.frames={frames}", f"out={tmp_path / str(number)}"], env=environment, capture_output=True)
        assert run.returncode == 0, run.stderr
        said.append(int(match[1]) if (match := re.search(rb"compiling (\d+) functions", run.stderr)) else 0)
    assert said[0] > said[1] > kernels.FEW and said[2] <= kernels.FEW
    tracked = [(tmp_path / number / "trajectory.txt").read_bytes() for number in "12"]
    assert tracked[0] == tracked[1]


@pytest.mark.slow
def test_a_kernel_that_another_calls_is_compiled_whole_and_to_the_same_bits(tmp_path):
    """`search_axes`, which is compiled first, has `orthonormal` as a part."""
    printed = []
    for way in ("ahead", "when called"):
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / way)}
        printed.append(subprocess.run([sys.executable, "-c", PROGRAM, way], env=environment, capture_output=True, text=True, check=True).stdout)
    assert printed[0] == printed[1] != ""


@pytest.mark.slow
def test_a_kernel_compiled_ahead_is_as_fast(tmp_path):
    """With what it calls linked into it as it was written, it took two thirds longer."""
    ms = []
    for way in ("ahead", "when called"):
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / way)}
        ms.append(float(subprocess.run([sys.executable, "-c", TIMED, way], env=environment, capture_output=True, text=True, check=True).stdout))
    assert ms[0] < 1.25 * ms[1]


@pytest.mark.slow
def test_a_run_after_compiling_ahead_compiles_nothing(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def compiled(*words):
        program = [sys.executable, "-c", "import sys; from trihedron.pipeline.app.cli import main; sys.exit(main(sys.argv[1:]))", *words]
        subprocess.run(program, env=environment, capture_output=True, check=True, cwd=tmp_path)
        return {file: file.stat().st_mtime_ns for file in (tmp_path / "cache").rglob("*.nbi")}

    ahead = compiled("compile")
    assert len(ahead) > 90
    for number, words in enumerate(RUNS):
        assert compiled("run", *words, f"out={number}") == ahead
