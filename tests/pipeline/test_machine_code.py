"""The machine code that a wheel carries: found where it fits, refused with a reason where it does not, and equal to what is compiled on the spot."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from trihedron.pipeline.core import machine_code
from trihedron.pipeline.core.machine_code import FEATURES, archive, archive_name, pack, unpack, why_unused

PACKAGE = Path(machine_code.__file__).parents[2]


@pytest.fixture(autouse=True)
def forgotten(tmp_path, monkeypatch):
    """An installation with a folder of machine code of its own, of which nothing is remembered."""
    monkeypatch.setattr(machine_code, "FOLDER", tmp_path / "machine_code")
    monkeypatch.delenv("NUMBA_CPU_NAME", raising=False)
    monkeypatch.delenv("NUMBA_CPU_FEATURES", raising=False)
    (tmp_path / "machine_code").mkdir()
    for cached in (archive, why_unused):
        cached.cache_clear()
    yield
    for cached in (archive, why_unused):
        cached.cache_clear()


@pytest.fixture
def carried(tmp_path):
    """An archive of one module for these versions."""
    (tmp_path / "cache" / "module-1").mkdir(parents=True)
    (tmp_path / "cache" / "module-1" / "f.nbi").write_bytes(b"index")
    pack(tmp_path / "cache", tmp_path / "machine_code" / archive_name())


def test_what_the_archive_has_is_unpacked_once(carried, tmp_path):
    folder = tmp_path / "user" / "module-1"
    unpack(folder)
    assert (folder / "f.nbi").read_bytes() == b"index" and [file.name for file in folder.parent.iterdir()] == ["module-1"]
    (folder / "f.nbi").write_bytes(b"more")
    unpack(folder)
    assert (folder / "f.nbi").read_bytes() == b"more"


def test_what_the_archive_lacks_is_left_to_the_compiler(carried, tmp_path):
    unpack(tmp_path / "user" / "module-2")
    assert not (tmp_path / "user").exists()


def test_without_an_archive_it_says_so(tmp_path):
    assert archive() is None and why_unused() == "this installation carries no machine code"
    unpack(tmp_path / "user" / "module-1")
    assert not (tmp_path / "user").exists()


def test_other_versions_and_processors_are_named(carried, tmp_path, monkeypatch):
    monkeypatch.setattr(machine_code.binding, "get_host_cpu_features", lambda: {**dict.fromkeys(FEATURES, True), "fma": False})
    assert why_unused() == "the machine code of this installation is for x86-64-v3, and this processor lacks fma"
    why_unused.cache_clear()
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    assert why_unused() == "NUMBA_CPU_NAME or NUMBA_CPU_FEATURES chooses another processor"
    why_unused.cache_clear()
    (tmp_path / "machine_code" / archive_name()).rename(tmp_path / "machine_code" / "py39-other.zip")
    assert why_unused() == f"the machine code of this installation is py39-other.zip, which is not for {archive_name()[:-4]}"


def test_equal_kernels_make_equal_archives(carried, tmp_path):
    os.utime(tmp_path / "cache" / "module-1" / "f.nbi", (0, 0))
    pack(tmp_path / "cache", tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == (tmp_path / "machine_code" / archive_name()).read_bytes()


PROGRAM = """
import json, sys
import numpy as np
from trihedron.pipeline.run.warm_up import compilations
count = 0
def counted():
    global count
    count += 1
with compilations(counted):
    from trihedron.pipeline.core.linalg_kernels import inverse_positive
    A = np.random.default_rng(0).normal(size=(6, 9))
    found = inverse_positive(A @ A.T)
print(json.dumps([count, found.tobytes().hex()]))
"""


def printed(package, cache, **variables):
    environment = {**os.environ, "PYTHONPATH": str(package.parent), "XDG_CACHE_HOME": str(cache), "NUMBA_CACHE_DIR": "", **variables}
    return json.loads(subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, check=True, timeout=120).stdout)


@pytest.mark.skipif(not machine_code.binding.get_host_cpu_features().get("avx2"), reason="the processor has no AVX2")
def test_a_kernel_of_the_wheel_is_not_compiled_and_gives_equal_bytes(tmp_path):
    package = tmp_path / "installed" / "trihedron"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__", "machine_code"))
    natively = printed(package, tmp_path / "first")
    built = tmp_path / "built"
    printed(package, built, NUMBA_CPU_NAME=machine_code.BASELINE, NUMBA_CPU_FEATURES="")
    (package / "machine_code").mkdir()
    pack(next((built / "trihedron" / "kernels").iterdir()), package / "machine_code" / archive_name())
    count, found = printed(package, tmp_path / "user")
    assert count == 0 < natively[0] and found == natively[1]
    assert [folder.name.endswith(machine_code.BASELINE) for folder in (tmp_path / "user" / "trihedron" / "kernels").iterdir()] == [True]
