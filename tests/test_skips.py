"""A run of the tests fails when one is skipped for a reason that is not allowed, and says which and what to do."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SKIPS = Path(__file__).with_name("skips.py")
ALLOWED = """
import pytest

def test_runs():
    assert 1 + 1 == 2

@pytest.mark.parametrize("k", [0, 1])
def test_sequence(k):
    pytest.skip("kitchen is not beside this checkout")
"""
OTHERS = """
import pytest

@pytest.fixture(scope="module")
def browser():
    pytest.skip("no chromium here; install it with: apt-get install chromium")

def test_browser(browser):
    pass

def test_package():
    pytest.importorskip("no_such_package")

@pytest.mark.skipif(True, reason="someone was in a hurry")
def test_hurry():
    pass
"""
MODULE = "import pytest\npytest.importorskip('no_such_package')\ndef test_never(): pass\n"
SAID = [
    "FAILED test_others.py::test_browser: skipped: no chromium here; install it with: apt-get install chromium",
    "FAILED test_others.py::test_package: skipped: could not import 'no_such_package': No module named 'no_such_package'; "
    "install it with: pip install -e '.[dev]'",
    "FAILED test_others.py::test_hurry: skipped: someone was in a hurry; make the test run, or add the reason to ALLOWED in tests/skips.py",
    "FAILED test_whole.py: skipped: could not import 'no_such_package': No module named 'no_such_package'; install it with: pip install -e '.[dev]'",
]


@pytest.fixture
def run(tmp_path):
    """Run pytest on files in a folder of their own, with the accounting of this one: exit status and printed lines."""
    shutil.copy(SKIPS, tmp_path / "conftest.py")

    def of(files, *words):
        for name, text in files.items():
            (tmp_path / name).write_text(text)
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:dash", "-p", "no:cacheprovider", "--rootdir", str(tmp_path), *words, str(tmp_path)]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        return done.returncode, done.stdout.splitlines()

    return of


def test_an_allowed_skip_passes_and_is_listed_once(run):
    code, lines = run({"test_allowed.py": ALLOWED}, "-n", "2")
    assert code == 0 and "2 skipped: kitchen is not beside this checkout (the published sequences are gigabytes)" in lines
    assert [line for line in lines if line.startswith("FAILED")] == []


@pytest.mark.parametrize("words", [(), ("-n", "2")], ids=["one process", "two workers"])
def test_any_other_skip_fails_the_run_with_a_line(run, words):
    code, lines = run({"test_allowed.py": ALLOWED, "test_others.py": OTHERS, "test_whole.py": MODULE}, *words)
    assert code == 1 and sorted(line for line in lines if line.startswith("FAILED")) == sorted(SAID)
    assert "2 skipped: kitchen is not beside this checkout (the published sequences are gigabytes)" in lines


def test_open3d_that_does_not_load_names_the_debian_package(run):
    """A module in its place fails as Open3D does without libusb."""
    broken = "message = 'libusb-1.0.so.0: cannot open shared object file: No such file or directory'\nraise ImportError(message)\n"
    test = "import pytest\n@pytest.mark.parametrize('name', ['open3d_voxels', 'tsdf'])\ndef test_surface(name): pass\n"
    code, lines = run({"open3d.py": broken, "test_surface.py": test})
    [line] = [line for line in lines if line.startswith("FAILED")]
    assert code == 1 and line.startswith("FAILED test_surface.py::test_surface[open3d_voxels]: skipped: open3d needs libusb-1.0.so.0")
    assert "with: apt-get install " in line and line.endswith("libusb-1.0-0")
