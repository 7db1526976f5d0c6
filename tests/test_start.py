"""Starting costs: the help imports nothing, and compiled kernels survive where the package cannot be written to."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import trihedron.pipeline.app.cli
from trihedron.tools.benchmark import PROGRAM

PACKAGE = Path(trihedron.pipeline.app.cli.__file__).parents[2]


def test_the_help_imports_no_library():
    """Libraries take seconds to import."""
    program = "import sys; before = set(sys.modules); from trihedron.pipeline.app.cli import main; assert main(['--help']) == 0; "
    program += "print(*set(sys.modules) - before)"
    printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.splitlines()
    imported = {name.partition(".")[0] for name in printed[-1].split()}
    assert "trihedron" in imported and imported - {"trihedron"} <= sys.stdlib_module_names


def test_the_plugins_import_no_library_that_few_of_them_use():
    """What one plugin computes with is imported when it computes."""
    program = "import sys; from trihedron.pipeline.core.registry import load_plugins; load_plugins(); print(*sys.modules)"
    imported = set(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split())
    heavy = {"scipy.ndimage", "scipy.optimize", "scipy.spatial", "scipy.sparse", "scipy.stats", "matplotlib", "open3d", "onnxruntime", "pycolmap"}
    assert not heavy & imported


def test_windows_is_refused_in_words():
    program = "import sys; sys.platform = 'win32'; import trihedron"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stderr.splitlines()[-1]
    assert said == "ImportError: trihedron does not run on Windows itself; install it in WSL 2, see docs/how-to/macos-and-windows.md"


@pytest.mark.slow
def test_kernels_survive_in_the_users_cache_when_the_package_is_read_only(tmp_path):
    """A file in the place of every __pycache__ folder: nothing can be kept beside the sources, whoever asks."""
    package, cache = tmp_path / "site" / "trihedron", tmp_path / "cache"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in [package, *(path for path in package.rglob("*") if path.is_dir())]:
        (folder / "__pycache__").touch()
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(package.parent), "XDG_CACHE_HOME": str(cache), "HOME": str(tmp_path), "TRIHEDRON_COMPILE": "0"}

    def run(name):
        words = ["run", "dataset.width=160", "dataset.height=120", "dataset.length=3", f"out={tmp_path / name}"]
        done = subprocess.run([*PROGRAM, *words], env=environment, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr[-1000:]
        return {file: file.stat().st_mtime_ns for file in cache.rglob("*.nb[ic]")}

    compiled = run("first")
    assert len(compiled) > 60
    assert compiled.items() <= run("second").items()  # which may compile what the first had no need of
