"""What the default graph compiles is listed, so that other cores can do it."""

import importlib
import json
import os
import subprocess
import sys

import numba
import numpy as np
import pytest
from numba import typeof, types

from trihedron.datasets.synthetic import Synthetic
from trihedron.pipeline import kernels
from trihedron.pipeline.kernels import LISTED, type_of, word_of
from trihedron.plugins.numerics.motion.pose_kernel import Flags

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
        (flags, {"trihedron.plugins.numerics.motion.pose_kernel:Flags": ["uint8[1C]"] * 3}),
        (np.zeros((2, 3), [("n", "f8"), ("z", "f4")]), {"[2C]": [["n", "<f8"], ["z", "<f4"]]}),
    ):
        assert word_of(typeof(value)) == word and type_of(word) == typeof(value), word


def test_the_longest_are_listed_first_and_others_kernels_never():
    misses = kernels.Misses()
    misses.kernels = [("trihedron.x:short", (types.int64,)), ("numba.x:y", (types.int64,)), ("trihedron.x:long", (types.float64,))]
    misses.kernels.append(("trihedron.x:text", (types.unicode_type,)))
    misses.seconds = [1.0, 9.0, 2.0, 9.0]
    assert kernels.listed(misses) == [["trihedron.x:long", ["float64"]], ["trihedron.x:short", ["int64"]]]


def test_what_is_called_belongs_to_the_kernel_that_python_calls():
    inner = numba.njit(lambda x: x + 1)
    outer = numba.njit(lambda x: inner(x) + 1)
    misses = kernels.Misses()
    with kernels.watched(misses):
        outer(1)
    assert len(misses.kernels) == len(misses.seconds) == 1 and misses.seconds[0] > 0.0


def test_a_graph_uses_the_modules_that_its_plugins_take_something_from():
    used = kernels.used_by([Synthetic()])
    assert {"trihedron.datasets.raytracing", "trihedron.pipeline.gathering", "trihedron.pipeline.row_kernels"} <= used
    assert "trihedron.plugins.numerics.planes.plane_fitting" not in used


def test_a_plugin_whose_module_only_another_process_knows_uses_what_can_be_seen():
    unknown = type("Sent", (), {"__module__": "nowhere.to_be_found"})()
    assert "trihedron.datasets.raytracing" in kernels.used_by([unknown, Synthetic()])


PROGRAM = """
import json, sys
import numpy as np
from trihedron.datasets.synthetic import Synthetic
from trihedron.pipeline import kernels
from trihedron.plugins.numerics.axes.sphere_modes import orthonormal

names = ("sphere_modes:orthonormal", "sphere_modes:search_axes")
rows = [row for row, (kernel, _) in enumerate(json.loads(kernels.LISTED.read_text())) if kernel.endswith(names)]
modules = {"trihedron.plugins.numerics.axes.sphere_modes"}
before = kernels.missing(modules)
if sys.argv[1] == "ahead":
    assert list(kernels.compile_rows(rows, 1)) == [1, 2]
    assert set(before) - set(kernels.missing(modules)) == set(rows)
print(orthonormal(np.arange(9.0).reshape(3, 3) ** 2 % 7, np.ones(3)).tolist())
"""


@pytest.mark.slow
def test_a_kernel_that_another_calls_is_compiled_whole_and_to_the_same_bits(tmp_path):
    """`search_axes`, which is compiled first, has `orthonormal` as a part."""
    printed = []
    for way in ("ahead", "when called"):
        environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / way)}
        printed.append(subprocess.run([sys.executable, "-c", PROGRAM, way], env=environment, capture_output=True, text=True, check=True).stdout)
    assert printed[0] == printed[1] != ""


@pytest.mark.slow
def test_a_run_after_compiling_ahead_compiles_nothing(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def compile(*words):
        program = [sys.executable, "-c", "import sys; from trihedron.tools.compile import main; sys.exit(main(sys.argv[1:]))", *words]
        return subprocess.run(program, env=environment, capture_output=True, text=True, check=True, cwd=tmp_path).stdout

    assert compile().startswith("ready after ")
    assert json.loads(compile("--list")) == []
