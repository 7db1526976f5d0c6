"""The rules of the house that a reader of one file cannot see: who imports whom, how long things are, that everything says what it is."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ORDER = (
    "errors", "mcap_writer", "chunk_writer", "mcap_errors", "mcap_chunks", "mcap_file", "arrays", "camera", "gathering", "row_kernels", "table",
    "maps", "surface", "types", "geometry", "slots", "registry", "wire_format", "array_codec", "table_codec", "codec", "foxglove_messages",
    "foxglove", "graph", "metrics", "consistency", "plot", "ply", "heap", "timing", "recording", "live", "runs", "scheduler", "interrupts", "intake",
    "state", "runner", "results", "config", "jobs", "cluster", "sweep", "search", "engines", "kernels", "compiler_shortcuts", "kernel_compiler",
    "preparation", "execute", "cli",
)  # fmt: skip
NUMERICS = ("algebra", "images", "depth", "planes", "axes", "motion", "maps", "bundle", "places", "surfaces")  # each imports those before it
VOCABULARY = {"types", "geometry", "errors", "slots", "registry"}  # what plugins and data sets know of the machinery
EXCEPTIONS = {
    ("datasets/mcap.py", "pipeline.recording"),  # reads what the machinery writes
    ("datasets/mcap.py", "pipeline.mcap_file"),
    ("datasets/robot_streams.py", "pipeline.mcap_file"),
    ("datasets/robot_recording.py", "pipeline.mcap_file"),
    ("pipeline/results.py", "datasets.trajectories"),  # the one text format of trajectories
    ("pipeline/execute.py", "datasets.trajectories"),
}
LONGEST_FILE, LONGEST_FUNCTION = 300, 80
FOLDERS = ("pipeline", "plugins", "datasets", "tools", "conf")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def imports(path: Path) -> Iterator[str]:
    """Modules of this package that a file imports, without `trihedron.`: pipeline.types, plugins.numerics.maps.landmarks."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno} imports relatively"
            names = [node.module or ""]
            if (ROOT / (node.module or "").replace("trihedron", ".", 1).replace(".", "/").strip("/")).is_dir():
                names = [f"{node.module}.{alias.name}" for alias in node.names]  # from trihedron.pipeline import results
        else:
            continue
        for name in names:
            assert name.split(".")[0] not in FOLDERS, f"{path} imports {name}, which is only found in the source folder"
            if name.startswith("trihedron."):
                yield name.removeprefix("trihedron.")


def allowed(path: str, target: str) -> bool:
    """Whether the file (relative to the root) may import the module."""
    if (path, target) in EXCEPTIONS:
        return True
    folder, (package, *rest) = path.split("/")[0], target.split(".")
    module = rest[0] if rest else ""
    if folder == "pipeline":
        return package == "pipeline" and ORDER.index(module) < ORDER.index(Path(path).stem)
    if folder == "tools":
        return package in ("pipeline", "datasets", "plugins", "tools")
    if package == "pipeline":
        return module in VOCABULARY
    if folder == "datasets":
        return package == "datasets"
    if not target.startswith("plugins.numerics.") or folder != "plugins":
        return False
    inside = path.split("/")[2] if path.startswith("plugins/numerics/") else NUMERICS[-1]
    return NUMERICS.index(rest[1]) <= NUMERICS.index(inside)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path):
    name = str(path.relative_to(ROOT))
    wrong = [target for target in imports(path) if not allowed(name, target)]
    assert not wrong, f"{name} must not import {', '.join(wrong)}"


def test_the_rule_refuses_what_it_should():
    assert allowed("pipeline/geometry.py", "pipeline.types")
    assert not allowed("pipeline/types.py", "pipeline.geometry")
    assert not allowed("pipeline/runner.py", "plugins.numerics.maps.landmarks")
    assert not allowed("pipeline/runner.py", "tools.evaluate")
    assert allowed("plugins/pose/refine.py", "plugins.numerics.maps.landmarks")
    assert allowed("plugins/numerics/maps/merging.py", "plugins.numerics.planes.plane_fusion")
    assert not allowed("plugins/numerics/planes/plane_fusion.py", "plugins.numerics.maps.merging")
    assert not allowed("plugins/pose/refine.py", "plugins.map.covisibility")
    assert not allowed("plugins/pose/refine.py", "pipeline.runner")
    assert not allowed("datasets/tum.py", "plugins.numerics.maps.landmarks")
    assert not allowed("datasets/tum.py", "tools.plugins")


def test_every_module_of_the_machinery_has_its_place():
    assert {path.stem for path in (ROOT / "pipeline").glob("*.py")} - {"__init__"} == set(ORDER)


def functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_size_documentation_and_annotations(path):
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    found = []
    if text.count("\n") > LONGEST_FILE:
        found.append(f"{text.count(chr(10))} lines")
    if text.strip() and not ast.get_docstring(tree):
        found.append("no docstring")
    for function in functions(tree):
        if function.end_lineno - function.lineno + 1 > LONGEST_FUNCTION:
            found.append(f"{function.name} has {function.end_lineno - function.lineno + 1} lines")
        arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs, function.args.vararg, function.args.kwarg]
        bare = [a.arg for a in arguments if a is not None and a.annotation is None and a.arg not in ("self", "cls")]
        if bare or function.returns is None:
            found.append(f"{function.name} is not annotated: {', '.join(bare) or 'its result'}")
    for node in tree.body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and not node.name.startswith("_") and not ast.get_docstring(node):
            found.append(f"{node.name} has no docstring")
    assert not found, f"{path.relative_to(ROOT)}: {'; '.join(found)}"
