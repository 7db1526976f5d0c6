"""Kernels are compiled once, cached by content, and their compilation is reported."""

import ast
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numba
import pytest

from trihedron.pipeline.app import compilation
from trihedron.pipeline.core import kernel as kernels
from trihedron.pipeline.core.config import compose_run, graph_of
from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.kernel import KernelCache, kernel, source_key
from trihedron.pipeline.core.registry import plugin_class
from trihedron.pipeline.run import warm_up

ROOT = Path(__file__).parents[2]
MODULES = [path for folder in ("pipeline", "plugins", "datasets", "tools") for path in sorted((ROOT / folder).rglob("*.py"))]
PUBLIC = {"numba", "numba.types", "numba.typed", "numba.extending", "numba.core.event"}  # as numba's documentation lists them
RUN = [sys.executable, "-m", "trihedron", "run"]
SMALL = ["dataset.width=160", "dataset.height=120", "dataset.frames=0:2", "outputs=[keypoints]"]
COMPILES = "for this machine, once"


def numba_names(tree):
    """Names that a module takes from numba: modules imported, names imported from them, attributes of `numba`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names if alias.name.partition(".")[0] == "numba")
        if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "numba":
            yield from ((f"{node.module}.{alias.name}", "") if node.module == "numba.core" else (node.module, alias.name) for alias in node.names)
        if isinstance(node, ast.Attribute) and ast.unparse(node).startswith("numba."):
            yield "numba", ast.unparse(node).removeprefix("numba.")


def test_only_documented_parts_of_numba_are_used():
    names = [(path, *found) for path in MODULES for found in numba_names(ast.parse(path.read_text()))]
    assert len({path for path, *_ in names}) >= 3  # it sees those that import numba
    for path, module, name in names:
        assert module in PUBLIC, f"{path}: {module} is not documented"
        assert name.partition(".")[0] != "core" and not any(part.startswith("_") and not part.startswith("__") for part in name.split(".")), path


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A package of three modules in the place of the project: `caller` imports `callee`, `other` stands alone."""
    (tmp_path / "trihedron" / "sub").mkdir(parents=True)
    (tmp_path / "trihedron" / "__init__.py").touch()
    (tmp_path / "trihedron" / "sub" / "__init__.py").touch()
    (tmp_path / "trihedron" / "sub" / "callee.py").write_text("FACTOR = 2.0\n")
    (tmp_path / "trihedron" / "caller.py").write_text("from trihedron.sub import (\n    callee,\n)\n")
    (tmp_path / "trihedron" / "other.py").write_text("import math\n")
    monkeypatch.setattr(kernels, "ROOT", tmp_path / "trihedron")
    forget()
    yield tmp_path / "trihedron"
    forget()


def forget():
    for cached in (kernels.source_key, kernels._source, kernels._writable):
        cached.cache_clear()


def test_a_change_of_an_imported_module_changes_the_key(project):
    before = source_key("trihedron.caller"), source_key("trihedron.other")
    forget()
    (project / "sub" / "callee.py").write_text("FACTOR = 3.0\n")
    after = source_key("trihedron.caller"), source_key("trihedron.other")
    assert before[0] != after[0] and before[1] == after[1]


def test_modules_that_import_each_other_have_a_key(project):
    (project / "sub" / "callee.py").write_text("import trihedron.caller\n")
    assert len(source_key("trihedron.caller")) == 64


def function(module):
    made = type(forget)(compile("def f(): pass", "f.py", "exec").co_consts[0], {"__name__": module})
    assert made.__module__ == module
    return made


def test_equal_sources_share_a_folder_wherever_they_are(project, tmp_path, monkeypatch):
    monkeypatch.setattr(kernels.CONFIG, "CACHE_DIR", str(tmp_path / "cache"))
    here = KernelCache.from_function(function("trihedron.caller"), "/one/place/caller.py")
    there = KernelCache.from_function(function("trihedron.caller"), "/another/place/caller.py")
    assert here.get_cache_path() == there.get_cache_path() and here.get_source_stamp() == there.get_source_stamp() == source_key("trihedron.caller")
    expected = tmp_path / "cache" / f"numba-{numba.__version__}" / f"caller-{source_key('trihedron.caller')[:16]}"
    assert Path(here.get_cache_path()) == expected and expected.is_dir()


def test_functions_of_others_and_folders_that_cannot_be_written_are_left_to_numba(project, tmp_path, monkeypatch):
    assert KernelCache.from_function(function("another.module"), "module.py") is None
    (tmp_path / "file").touch()
    monkeypatch.setattr(kernels.CONFIG, "CACHE_DIR", str(tmp_path / "file"))
    assert KernelCache.from_function(function("trihedron.caller"), "caller.py") is None


def test_the_users_cache_folder_is_used_unless_numba_is_given_one(monkeypatch, tmp_path):
    monkeypatch.setattr(kernels.CONFIG, "CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert kernels.cache_folder() == tmp_path / "trihedron" / "kernels" / f"numba-{numba.__version__}"


def test_the_decorator_takes_further_options():
    plain, inlined = kernel(lambda x: x / 0.0), kernel(forceinline=True)(lambda x: x + 1.0)
    assert plain(1.0) == float("inf") and inlined(1.0) == 2.0


def test_what_is_compiled_is_counted_and_reported_in_plain_lines(capsys, monkeypatch):
    monkeypatch.setattr(warm_up, "PLAIN_SECONDS", -1.0)
    half = numba.njit(lambda x: 0.5 * x)
    with warm_up.compilation_reported():
        assert half(3.0) == 1.5 and half(5.0) == 2.5
    line = "compiling functions called for the first time, for this machine, once"
    assert capsys.readouterr().err == f"{line} ...\n{line}: 1 after 0 s\n"
    with warm_up.compilation_reported():
        assert half(7.0) == 3.5
    assert capsys.readouterr().err == ""


def test_the_total_of_the_progress_is_never_less_than_what_is_done(capsys, monkeypatch):
    monkeypatch.setattr(warm_up, "PLAIN_SECONDS", -1.0)
    progress = warm_up.Progress("of tracking", 2)
    for _ in range(3):
        progress.update()
    assert re.findall(r": (\d of about \d)", capsys.readouterr().err) == ["1 of about 2", "2 of about 2", "3 of about 3"]


@pytest.fixture
def compiled(tmp_path, monkeypatch):
    """What `compile_once` asked for, with an empty cache."""
    asked = []
    monkeypatch.setattr(kernels.CONFIG, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("TRIHEDRON_COMPILE", "1")
    monkeypatch.setattr(compilation, "compile_kernels", asked.append)
    return asked


def test_a_run_compiles_beforehand_what_its_kind_needs(compiled):
    compilation.compile_once(["dataset", *compilation.STAGES], frames=60)
    compilation.compile_once(["dataset", *compilation.STAGES], frames=500)
    compilation.compile_once(["dataset", *compilation.STAGES], frames=None)
    compilation.compile_once(["dataset", "keypoints"], frames=None)
    assert compiled == ["tracking", "all", "all", "all"]


@pytest.mark.parametrize("what", compilation.PARTS)
def test_what_the_two_processes_run_is_a_graph(what):
    """All but the replay, which needs a recording. Until both run all stages, neither has what the other compiles: see the module's docstring."""
    graphs = [[graph_of(compose_run(words)).stages for words in part if words != compilation.AGAIN] for part in compilation.PARTS[what]]
    (directions, unrefined, *_), (points, *_) = graphs
    assert "manhattan" in directions and "pose" not in directions
    assert {"bundle", "manhattan"} <= set(unrefined) and unrefined["pose"].plugin == plugin_class("pose", "none")()
    assert "pose" in points and "manhattan" not in points and points["bundle"].plugin == plugin_class("bundle", "none")()
    assert all({"lines", "planes", "manhattan", "bundle", "pose"} <= set(stages) for part in graphs for stages in part[2:])


def test_nothing_is_compiled_beforehand_twice_for_other_graphs_or_where_it_is_switched_off(compiled, monkeypatch):
    compilation.compile_once(["dataset", "keypoints"], frames=60)
    compilation.marker("all").parent.mkdir(parents=True)
    compilation.marker("all").touch()
    compilation.compile_once(sorted(compilation.STAGES), frames=60)
    compilation.marker("all").unlink()
    monkeypatch.setenv("TRIHEDRON_COMPILE", "0")
    compilation.compile_once(sorted(compilation.STAGES), frames=None)
    assert compiled == []


@pytest.fixture
def worker(tmp_path, monkeypatch):
    """Processes of `compile_kernels` that print a line each, as for one function, with an empty cache."""
    monkeypatch.setattr(kernels.CONFIG, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compilation.sys, "executable", "echo")


def test_the_line_says_what_is_compiled(worker, monkeypatch, capsys):
    monkeypatch.setattr(warm_up, "PLAIN_SECONDS", -1.0)
    compilation.compile_kernels("tracking")
    printed = capsys.readouterr().err.splitlines()
    assert printed[0] == "compiling functions of tracking, for this machine, once ..."
    assert f"1 of about {compilation.SHOWN['tracking'][1]} after" in printed[1]
    compilation.compile_kernels()
    printed = capsys.readouterr().err.splitlines()
    assert printed[0] == "compiling functions of surfaces, loops, a loss and relocalisation, for this machine, once ..."
    assert f"1 of about {compilation.SHOWN['later'][1]} after" in printed[1]


def test_all_is_compiled_at_once_where_nothing_was_before(worker, capsys):
    compilation.compile_kernels()
    expected = "compiling functions of tracking, surfaces, loops, a loss and relocalisation, for this machine, once ...\n"
    assert capsys.readouterr().err == expected


def test_a_failed_process_is_an_error_and_leaves_no_marker(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels.CONFIG, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compilation.sys, "executable", "false")
    with pytest.raises(TrihedronError, match="not all functions were compiled"):
        compilation.compile_kernels()
    assert not compilation.marker("all").exists()


def test_what_is_compiled_for_a_wheel_is_not_in_the_cache_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels.CONFIG, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compilation, "PARTS", {"wheel": ()})  # no process, so that nothing is compiled
    compilation.compile_for_wheel(tmp_path / "code.zip")
    assert zipfile.is_zipfile(tmp_path / "code.zip") and not (tmp_path / "cache").exists()


@pytest.mark.slow
def test_a_second_start_loads_what_the_first_compiled(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    printed, files = [], []
    for number in "12":
        done = subprocess.run([*RUN, *SMALL, f"out={tmp_path / number}"], env=environment, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        printed.append(COMPILES in done.stderr)
        files.append({file: file.stat().st_mtime_ns for file in (tmp_path / "cache").rglob("*.nb[ic]")})
    assert printed == [True, False] and files[0] == files[1] and len(files[0]) > 10


@pytest.mark.slow
def test_a_run_after_compiling_ahead_compiles_nothing(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    subprocess.run([*RUN[:-1], "compile"], env=environment, check=True, cwd=tmp_path)
    for number, words in enumerate([compilation.WHOLE, compilation.SURFACE, compilation.FOUND, compilation.UNKNOWN, compilation.TURN]):
        done = subprocess.run([*RUN, *words, f"out={tmp_path / str(number)}"], env=environment, capture_output=True, text=True, cwd=tmp_path)
        assert done.returncode == 0 and COMPILES not in done.stderr
