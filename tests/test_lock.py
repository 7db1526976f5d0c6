"""The lock of versions: it satisfies what the project asks for on every supported Python, and lacks nothing that is installed."""

import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from setuptools.config.pyprojecttoml import load_file

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "constraints.txt"
PROJECT = load_file(ROOT / "pyproject.toml")["project"]
PYTHONS = [line.rpartition(" ")[2] for line in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", line)]
sys.path.insert(0, str(ROOT / ".ci"))
from differences import locked_versions  # noqa: E402


def environment(python: str) -> dict[str, str]:
    """Markers (PEP 508) of a Python on Linux, x86-64."""
    names = {"python_version": python, "python_full_version": f"{python}.9", "implementation_name": "cpython", "os_name": "posix"}
    return names | {"platform_python_implementation": "CPython", "platform_system": "Linux", "platform_machine": "x86_64", "sys_platform": "linux"}


@pytest.mark.parametrize("python", PYTHONS)
def test_it_satisfies_every_requirement(python):
    markers = environment(python)
    versions = locked_versions(LOCK, markers)
    groups = {"": PROJECT["dependencies"], **PROJECT["optional-dependencies"]}
    for extra, lines in groups.items():
        for requirement in map(Requirement, lines):
            if requirement.name != "trihedron" and (requirement.marker is None or requirement.marker.evaluate(markers)):
                version = versions.get(canonicalize_name(requirement.name))
                assert version is not None and requirement.specifier.contains(version), f"[{extra}] {requirement}: {version} is locked"


def test_it_is_complete():
    """Every package that an installed one requires is in it; those of another version than the locked one may require others."""
    versions = locked_versions(LOCK)
    pending, seen = [Requirement("trihedron[dev]")], set()
    while pending:
        requirement = pending.pop()
        name, extras = canonicalize_name(requirement.name), requirement.extras or {""}
        if (name, frozenset(extras)) in seen:
            continue
        seen.add((name, frozenset(extras)))
        assert name == "trihedron" or name in versions, f"{name} is installed and not in {LOCK.name}: make lock"
        found = importlib.metadata.distribution(name)
        if name == "trihedron" or found.version == versions[name]:
            needed = map(Requirement, found.requires or ())
            pending += [line for line in needed if line.marker is None or any(line.marker.evaluate({"extra": extra}) for extra in extras)]
    assert len(seen) > 200


def test_two_versions_for_one_interpreter_are_an_error(tmp_path):
    lock = tmp_path / "lock.txt"
    lock.write_text("# by hand\nnumpy==2.2.6 ; python_full_version < '3.11'\nnumpy==2.4.6 ; python_full_version >= '3.10'\n")
    assert locked_versions(lock, environment("3.12")) == {"numpy": "2.4.6"}
    with pytest.raises(ValueError, match="two versions of numpy apply"):
        locked_versions(lock, environment("3.10"))


def test_everything_installs_by_it():
    """The environment of make, hosted tests, the container and what the README tells to type."""
    makefile = (ROOT / "Makefile").read_text()
    others = re.findall(r"^(?!PIP :=).*pip install (.*)$", makefile, re.MULTILINE)
    assert others == ["--quiet --constraint $(LOCK) dist/*.whl", "--quiet --constraint $(LOCK) uv"]
    assert "\nPIP := $(BIN)/python -m pip install --constraint $(LOCK)\n" in makefile and "\nLOCK := constraints.txt\n" in makefile
    for name in ("README.md", "Containerfile", "docs/how-to/install.md"):
        installs = re.findall(r"pip install [^`\n]*(?<=[\s'])\.(?:\[\w+\]'?)?(?=[\s`]|$)", (ROOT / name).read_text())
        assert installs and all("--constraint constraints.txt" in line for line in installs), f"{name}: {installs}"


def test_make_lock_installs_uv_alone():
    done = subprocess.run(["make", "--dry-run", "--always-make", "lock"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert re.findall(r"pip install .* (\S+)$", done.stdout, re.MULTILINE) == ["uv"] and "uv pip compile" in done.stdout


def test_what_make_makes_is_in_no_commit_and_no_container():
    """Every environment of the Makefile lies in a folder that both files name."""
    makefile = (ROOT / "Makefile").read_text()
    environments = {*re.findall(r"^VENV := (\S+)$", makefile, re.MULTILINE), *re.findall(r"VENV=(\S+)", makefile)}
    assert environments == {".venv", ".venv-newest"}
    for name in (".gitignore", ".dockerignore"):
        assert environments | {"build"} <= {line.rstrip("/") for line in (ROOT / name).read_text().splitlines()}, name
