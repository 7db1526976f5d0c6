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

from trihedron.pipeline import kernels
from trihedron.pipeline.kernels import LISTED, _type_of, _word_of, listed
from trihedron.plugins.numerics.motion.pose_kernel import Flags

ENTRIES = json.loads(LISTED.read_text())


@pytest.mark.parametrize("entry", ENTRIES, ids=[f"{kernel.split(':')[1]}-{row}" for row, (kernel, _) in enumerate(ENTRIES)])
def test_what_is_listed_is_a_kernel_and_takes_so_many_arguments(entry):
    kernel, arguments = entry
    module, name = kernel.split(":")
    function = getattr(importlib.import_module(module), name)
    assert function.py_func.__code__.co_argcount >= len(arguments)
    assert [_word_of(_type_of(word)) for word in arguments] == arguments


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
    ):
        assert _word_of(typeof(value)) == word and _type_of(word) == typeof(value), word
    assert listed([("trihedron.x:y", (types.unicode_type,)), ("numba.x:y", (types.int64,))]) == []


def test_other_cores_begin_with_the_third_kernel_that_no_cache_has(monkeypatch):
    begun = []
    monkeypatch.setattr(kernels, "begin_shares", lambda count: begun.append(count) or [subprocess.Popen([sys.executable, "-c", "input()"])])
    monkeypatch.setattr(kernels, "cores", lambda: 5)
    with kernels.compiled_beside():
        for compiled in range(4):
            assert begun == [4] * (compiled >= kernels.COLD)
            numba.njit(lambda x: x + 1)(1)
    numba.njit(lambda x: x + 2)(1)
    assert begun == [4]


@pytest.mark.slow
def test_a_run_after_compiling_ahead_compiles_nothing(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def compile(*words):
        program = [sys.executable, "-c", "import sys; from trihedron.tools.compile import main; sys.exit(main(sys.argv[1:]))", *words]
        return subprocess.run(program, env=environment, capture_output=True, text=True, check=True, cwd=tmp_path).stdout

    assert compile().startswith("ready after ")
    assert json.loads(compile("--list")) == []
