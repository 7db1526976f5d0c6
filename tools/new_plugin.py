"""Write the package of a new plugin: pyproject.toml, the plugin, its tests and a README, in the folder trihedron-NAME.

The plugin begins as a copy of its slot's default in behaviour: it installs, passes `trihedron check` and tracks at once, and its one marked line is
replaced by the new method.

Example: trihedron new-plugin planes my_planes
"""

from __future__ import annotations

import inspect
import keyword
import re
from pathlib import Path
from typing import Any, get_type_hints

from trihedron.pipeline.core.errors import DataError, UsageError, did_you_mean
from trihedron.pipeline.core.files import write_file
from trihedron.tools.arguments import Parser

TEMPLATE_SENTENCE = "State in one sentence what the method computes (Author, venue, year)."  # no documentation for `trihedron check`
WIDE = 6  # arguments that fit into one line
PYPROJECT = """\
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "trihedron-{package}"
version = "0.1.0"
description = "{slot}={name} for Trihedron"
readme = "README.md"
requires-python = ">=3.10"
dependencies = ["trihedron"]

[project.entry-points."trihedron.plugins"]
{name} = "trihedron_{name}"

[tool.setuptools]
py-modules = ["trihedron_{name}"]
"""

PLUGIN = '''\
"""{slot}={name}."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
{imports}

@register("{slot}", "{name}")
@dataclass(frozen=True)
class {kind}:
    """{sentence}

    Options are fields: a type with a range, a default, and a comment, for example
    `angle_deg: Annotated[float, Range(0, 90)] = 5.0  # between normals of one region`."""

    @cached_property
    def _method(self) -> {default}:
        """The default plugin, until there is a method."""
        return {default}()
{methods}'''

CALL = '''
    def __call__({parameters}) -> {returned}:
        """Return the slot's value; `trihedron plugins {slot}` describes its inputs."""
        return self._method({arguments})  # replace this line
'''

FOLD = '''
    def start(self) -> Any:
        """Return a state in which nothing was seen."""
        return self._method.start()

    def add({parameters}) -> Any:
        """Take the state one frame further."""
        return self._method.add({arguments})  # replace this line

    def finish(self, state: Any, map: Map | None) -> {returned}:
        """Return the result at the final keyframes."""
        return self._method.finish(state, map)  # replace this line
'''

TEST = '''\
"""{slot}={name}: the contract of its slot, and a room."""

import json

from trihedron.pipeline.app.cli import main
from trihedron.tools.plugin_check import PluginCheck


def test_it_keeps_the_contract_of_its_slot():
    assert [result for result in PluginCheck("{slot}", "{name}").results(quick=True) if not result.good] == []


def test_the_room_is_tracked(tmp_path):
    words = ["dataset.width=320", "dataset.height=240", "dataset.length=20"]
    assert main(["run", "{slot}={name}", "outputs=[trajectory,{slot}]", *words, f"out={{tmp_path}}"]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["status"]["lost"] == 0 and metrics["final"]["ate_rmse_m"] < 0.02
'''

README = """\
# trihedron-{package}

```sh
pip install .
trihedron check {slot} {name}
trihedron run {slot}={name}
pytest
```
"""


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises UsageError for a slot that does not exist or a name that cannot be one, DataError for a folder
    that is there already."""
    parser = Parser("new-plugin", __name__)
    parser.add_argument("slot", metavar="SLOT")
    parser.add_argument("name", metavar="NAME", help="of the plugin, as in SLOT=NAME")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="default: trihedron-NAME")
    arguments = parser.parse(argv)
    slot, name = arguments.slot, arguments.name
    folder = arguments.out or Path(f"trihedron-{name.replace('_', '-')}")
    files = package_of(slot, name)
    if folder.exists():
        raise DataError(str(folder), "is there already", "give another --out FOLDER")
    folder.mkdir(parents=True)
    for file, text in files.items():
        write_file(folder / file, text)
        print(f"  {folder / file}")
    print(f"pip install -e {folder} && trihedron check {slot} {name} && trihedron run {slot}={name}")
    return 0


def package_of(slot: str, name: str) -> dict[str, str]:
    """Return file -> text of the package. Raises UsageError."""
    from trihedron.pipeline.core.config import default_plugins
    from trihedron.pipeline.core.registry import load_plugins, plugin_class, plugins_of
    from trihedron.pipeline.core.slots import SLOTS

    slots = [known for known in SLOTS if known != "dataset"]
    if slot == "dataset":
        raise UsageError("new-plugin", "there is no template of data sets", "convert the recording to a folder: docs/tutorial/own-recording.md")
    if slot not in SLOTS:
        raise UsageError("new-plugin", f"there is no slot '{slot}'", did_you_mean(slot, slots))
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name):
        raise UsageError("new-plugin", f"'{name}' cannot be the name of a plugin", "give small letters, digits and _, for example my_planes")
    load_plugins()
    if name in plugins_of(slot):
        raise UsageError("new-plugin", f"there is a plugin {slot}={name} already", "give another name")
    words = {"slot": slot, "name": name, "package": name.replace("_", "-")}
    module = _module(slot, name, plugin_class(slot, default_plugins()[slot]))
    return {
        "pyproject.toml": PYPROJECT.format(**words),
        f"trihedron_{name}.py": module,
        f"test_{name}.py": TEST.format(**words),
        "README.md": README.format(**words),
    }


def _module(slot: str, name: str, default: type[Any]) -> str:
    """The plugin's module, which calls the default plugin."""
    from trihedron.pipeline.core.registry import parameters_of_method
    from trihedron.pipeline.core.slots import FOLDS, method_of

    hints = {key: _text(hint) for key, hint in get_type_hints(getattr(default, method_of(slot))).items()}
    returned = hints["return"] if slot not in FOLDS else _text(get_type_hints(default.finish)["return"])
    parameters = parameters_of_method(slot, default)
    state = ["state: Any"] if slot in FOLDS else []
    listed = "".join(f"\n        {one}," for one in ("self", *state, *(f"{p}: {hints[p]}" for p in parameters))) + "\n    "
    given = [*(["state"] if slot in FOLDS else []), *(f"{p}={p}" for p in parameters)]
    passed = ", ".join(given) if len(given) <= WIDE else "".join(f"\n            {one}," for one in given) + "\n        "
    method = (FOLD if slot in FOLDS else CALL).format(slot=slot, parameters=listed, returned=returned, arguments=passed)
    used = " ".join([*(hints[p] for p in parameters), returned, "Map" if slot in FOLDS else ""])
    kind = "".join(part.capitalize() for part in name.split("_"))
    default_name = default.__name__ if default.__name__ != kind else f"Default{kind}"
    renamed = default.__name__ if default_name == default.__name__ else f"{default.__name__} as {default_name}"
    imports = "from typing import Any\n" if slot in FOLDS else ""
    imports += "\nimport numpy as np\n\n" if "np." in used else "\n"
    imports += "from trihedron.pipeline.core.registry import register\n"
    imports += f"from trihedron.pipeline.core.types import {', '.join(sorted(_types(used)))}\n"
    imports += f"from {default.__module__} import {renamed}\n"
    words = {"slot": slot, "name": name, "kind": kind, "sentence": TEMPLATE_SENTENCE}
    return PLUGIN.format(**words, imports=imports, default=default_name, methods=method)


def _text(hint: Any) -> str:
    """A type as it is written in the module."""
    if inspect.isclass(hint):
        return "np.random.Generator" if hint.__name__ == "Generator" else hint.__name__
    return str(hint).replace("trihedron.pipeline.core.types.", "").replace("typing.", "")


def _types(text: str) -> set[str]:
    """Names of the value types in a text."""
    from trihedron.pipeline.core import types

    return {word for word in re.findall(r"\w+", text) if word in types.__all__}
