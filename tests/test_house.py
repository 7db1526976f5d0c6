"""Rules that a reader of one file cannot see: who imports whom, what tools resolve, how long functions are, that everything is documented."""

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import is_dataclass, make_dataclass
from functools import cache, cached_property
from pathlib import Path
from types import FunctionType

import pytest

from trihedron.pipeline.core.registry import load_plugins, plugins_of
from trihedron.pipeline.core.slots import SLOTS

ROOT = Path(__file__).resolve().parents[1]
LONGEST_FUNCTION = 80
CLAUSE = re.compile(r"^(What|Whether|How|Of|Where|Which|As|Those|Not|Also|From|With)\b")
PRIVATE = re.compile(r"^(hydra|numba|numpy|submitit|joblib|distributed|mcap|cv2|foxglove)\b[\w.]*\._[a-z]")
FOLDERS = ("pipeline", "plugins", "datasets", "tools", "conf", "src/trihedron")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    """All nodes of a file of the project, its module first."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def test_layers():
    """The contracts are in pyproject.toml, `tool.importlinter`."""
    done = subprocess.run([Path(sys.executable).with_name("lint-imports"), "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_a_type_checker_resolves_every_own_import(tmp_path):
    """Editors see the package as Python does. All own imports of the checkout are put into one file: to check the whole tree takes minutes."""
    imports = {
        f"from {node.module} import {name.name} as _"
        for path in [*FILES, *(ROOT / "tests").rglob("*.py")]
        for node in nodes_of(path)
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "trihedron"
        for name in node.names
    }
    assert len(imports) > 500

    wrong = ["from trihedron.plugins.nowhere import x as _", "from trihedron.pipeline.core.types import Nothing as _"]
    for name, lines in (("imports", imports), ("wrong", wrong)):
        (tmp_path / f"{name}.py").write_text("\n".join(sorted(lines)))
    rules = {"reportMissingImports": "error", "reportAttributeAccessIssue": "error", "useLibraryCodeForTypes": False}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps({"extraPaths": [str(ROOT / "src")], "typeCheckingMode": "off", **rules}))
    command = [Path(sys.executable).with_name("basedpyright"), "-p", tmp_path, "--outputjson"]
    errors = json.loads(subprocess.run(command, capture_output=True, text=True).stdout)["generalDiagnostics"]
    assert [error for error in errors if Path(error["file"]).stem != "wrong"] == []
    assert [error["rule"] for error in errors] == ["reportAttributeAccessIssue", "reportMissingImports"]  # and it can fail


def test_nothing_imports_relatively_or_from_the_source_folder():
    for path in FILES:
        for node in nodes_of(path):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}:{node.lineno} imports relatively"
                names = [node.module or ""]
            assert not [name for name in names if name.split(".")[0] in FOLDERS], f"{path} imports {names}, which is only found in the source folder"


def test_size_documentation_and_annotations():
    assert not [line for path in FILES for line in style_of(path)]


def style_of(path: Path) -> list[str]:
    nodes = nodes_of(path)
    tree = nodes[0]
    found = []
    if tree.body and not ast.get_docstring(tree):
        found.append("no docstring")
    for function in (node for node in nodes if isinstance(node, ast.FunctionDef)):
        if function.end_lineno - function.lineno + 1 > LONGEST_FUNCTION:
            found.append(f"{function.name} has {function.end_lineno - function.lineno + 1} lines")
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs, function.args.vararg, function.args.kwarg]
        bare = [a.arg for a in arguments if a is not None and a.annotation is None and a.arg not in ("self", "cls")]
        if bare or function.returns is None:
            found.append(f"{function.name} is not annotated: {', '.join(bare) or 'its result'}")
    for node in tree.body:
        public = isinstance(node, (ast.ClassDef, ast.FunctionDef)) and not node.name.startswith("_") and "_kernels" not in path.stem
        if public and not ast.get_docstring(node) and "overload" not in [ast.unparse(d) for d in node.decorator_list]:
            found.append(f"{node.name} has no docstring")
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    texts = [ast.get_docstring(node) for node in nodes if isinstance(node, documented)]
    found += [f"the docstring '{text[:40]}' opens with a clause" for text in texts if text and CLAUSE.match(text)]
    return [f"{path.relative_to(ROOT)}: {line}" for line in found]


def test_no_private_member_of_a_library():
    assert not [name for path in FILES for name in private_names(path)]


def private_names(path: Path) -> list[str]:
    nodes = nodes_of(path)
    imports = [alias for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    libraries = {alias.asname or alias.name.split(".")[0]: alias.name for alias in imports}
    found = []
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            found += [f"{node.module}.{name.name}" for name in node.names if PRIVATE.match(f"{node.module}.{name.name}")]
        elif isinstance(node, ast.Attribute) and node.attr.startswith("_") and isinstance(node.ctx, (ast.Load, ast.Store)):
            head, _, rest = ast.unparse(node).partition(".")
            if head in libraries and PRIVATE.match(f"{libraries[head]}.{rest}"):
                found.append(f"{libraries[head]}.{rest}")
    return [f"{path.relative_to(ROOT)}: {name}" for name in found]


def test_plugins_share_options_and_no_behaviour():
    """A plugin derives from options, their checks and values made of them; methods are its own, and none derives from another plugin."""
    load_plugins()
    registered = {plugin for slot in SLOTS for plugin in plugins_of(slot).values() if plugin.__module__.startswith("trihedron.plugins")}
    assert len(registered) > 80
    generated = {name for name in vars(make_dataclass("Nothing", [("x", int)], frozen=True)) if name.startswith("__")}
    for plugin in registered:
        own = {name for name, value in vars(plugin).items() if callable(value) or isinstance(value, (property, cached_property))}
        for base in plugin.__mro__[1:-1]:
            assert base not in registered and is_dataclass(base), f"{plugin.__name__} derives from {base.__name__}"
            for name, value in vars(base).items():
                if name in generated or name in ("__post_init__", "__orig_bases__"):
                    continue
                assert not isinstance(value, (FunctionType, property, staticmethod, classmethod)), f"{base.__name__}.{name} is behaviour"
                assert name not in own or name in base.__dataclass_fields__, f"{plugin.__name__} overrides {base.__name__}.{name}"


# Recorded values depend on no BLAS or LAPACK (docs/decisions/0165), but for those of plugins on libraries.
ON_BLAS = {
    "plugins/loop/bag_of_words.py": "its words are the clusters of SciPy",
    "plugins/rotation/scipy_align.py": "its solution is that of SciPy",
    "plugins/translation/scipy_least_squares.py": "its optimiser is that of SciPy",
}
BLAS = re.compile(r"np\.(matmul|dot|vdot|inner|tensordot|convolve|correlate|cov|corrcoef|polyfit|linalg\.(?!LinAlgError)\w+)|.*\.dot", re.DOTALL)
BLAS_IMPORT = re.compile(r"scipy\.(?:linalg|optimize|sparse\.linalg|spatial\.transform|cluster)\b|numpy\.linalg import (?!LinAlgError)")


def blas_calls(nodes: Iterable[ast.AST]) -> list[str]:
    """What needs `pipeline.core.linalg` or `linalg_kernels` instead: `@`, products, `linalg` but for `norm` along an axis, `optimize` of einsum."""
    found, along_axis = [], set()
    for node in nodes:
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "np.linalg.norm" and "axis" in [word.arg for word in node.keywords]:
            along_axis.add(node.func)  # visited later
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            found += BLAS_IMPORT.findall(ast.unparse(node))
        elif isinstance(node, (ast.BinOp, ast.AugAssign)) and isinstance(node.op, ast.MatMult):
            found.append(ast.unparse(node))
        elif isinstance(node, ast.Attribute) and node not in along_axis and BLAS.fullmatch(text := ast.unparse(node)):
            found.append(text)
        elif isinstance(node, ast.keyword) and node.arg == "optimize":
            found.append(ast.unparse(node))
    return found


def test_what_is_recorded_depends_on_no_blas():
    folders = [ROOT / name for name in ("plugins", "pipeline/core", "pipeline/run", "pipeline/record", "datasets")]
    files = [*(ROOT / "src/trihedron").glob("*.py"), *(path for folder in folders for path in folder.rglob("*.py"))]
    found = {path.relative_to(ROOT).as_posix(): blas_calls(nodes_of(path)) for path in files}
    assert {path: calls for path, calls in found.items() if calls and path not in ON_BLAS} == {}
    assert all(found[path] for path in ON_BLAS)


def test_calls_of_blas_are_noticed():
    calls = ["a @ b", "a @= b", "np.dot(a, b)", "a.T.dot(b)", "np.linalg.norm(a)", "np.linalg.inv(a)", "np.einsum('ij,jk', a, b, optimize=True)"]
    for call in [*calls, "from scipy.sparse.linalg import splu"]:
        assert blas_calls(ast.walk(ast.parse(call))), call
    for call in ["np.linalg.norm(a, axis=1)", "np.linalg.LinAlgError", "np.einsum('ij,jk', a, b)", "matmul(a, b)", "from scipy.sparse import diags"]:
        assert not blas_calls(ast.walk(ast.parse(call))), call
