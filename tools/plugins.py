"""List the slots and the names of their plugins; of a slot its plugins; of a plugin its documentation and options.

A plugin is chosen as SLOT=PLUGIN, its options are set as SLOT.NAME=VALUE. A star marks what graph=structural uses.

Example: trihedron plugins manhattan mean_shift
"""

from __future__ import annotations

import inspect
import json
import re
from enum import Enum
from typing import Any

from trihedron.pipeline.core.comments import field_comments
from trihedron.pipeline.core.config import default_plugins
from trihedron.pipeline.core.errors import UsageError, did_you_mean
from trihedron.pipeline.core.text_table import table
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises UsageError for an unknown slot or plugin."""
    parser = Parser("plugins", __name__)
    parser.add_argument("slot", metavar="SLOT", nargs="?", help="only this slot")
    parser.add_argument("plugin", metavar="PLUGIN", nargs="?", help="only this plugin of it, with its options")
    parser.add_argument("--json", action="store_true", help="print everything as JSON")
    arguments = parser.parse(argv)
    from trihedron.pipeline.core.registry import broken_packages, load_plugins
    from trihedron.pipeline.core.slots import SLOTS

    if arguments.slot is not None and arguments.slot not in SLOTS:
        raise UsageError("plugins", f"there is no slot '{arguments.slot}'", did_you_mean(arguments.slot, SLOTS))
    load_plugins()
    described = [describe_slot(slot) for slot in SLOTS if arguments.slot in (None, slot)]
    if arguments.plugin is not None:
        described[0]["plugins"] = [_chosen(described[0], arguments.plugin)]
    if arguments.json:
        print(json.dumps({"slots": described, "broken": broken_packages()}, indent=2))
    elif arguments.plugin is not None:
        print(report_plugin(arguments.slot, described[0]["plugins"][0]))
    else:
        print(report_names(described, broken_packages()) if arguments.slot is None else report(described[0]))
    return 0


def _chosen(slot: dict[str, Any], name: str) -> dict[str, Any]:
    """The plugin of that name. Raises UsageError where there is none."""
    from trihedron.pipeline.core.registry import cure_of_unknown

    plugins = {plugin["name"]: plugin for plugin in slot["plugins"]}
    if name not in plugins:
        raise UsageError("plugins", f"the slot '{slot['name']}' has no plugin '{name}'", cure_of_unknown(slot["name"], name))
    chosen: dict[str, Any] = plugins[name]
    return chosen


def describe_slot(slot: str) -> dict[str, Any]:
    """Describe a slot as plain data: its contract, default wires and plugins, ready for JSON."""
    from trihedron.pipeline.core.registry import plugins_of
    from trihedron.pipeline.core.slots import FOLDS, SLOTS, default_wires, inputs_of, output_of, summary

    default = default_plugins().get(slot)
    return {
        "name": slot,
        "summary": summary(slot),
        "doc": inspect.getdoc(SLOTS[slot]) or "",
        "inputs": {name: type_name(hint) for name, hint in inputs_of(slot).items()},
        "wires": {name: str(wire) for name, wire in default_wires(slot).items()},
        "output": type_name(output_of(slot)),
        "fold": slot in FOLDS,
        "plugins": [describe_plugin(slot, name, plugin) | {"default": name == default} for name, plugin in plugins_of(slot).items()],
    }


def describe_plugin(slot: str, name: str, plugin: type[Any]) -> dict[str, Any]:
    """Describe a plugin as plain data: its inputs, its parameters with type, default, range and comment, ready for JSON."""
    from typing import get_type_hints

    from trihedron.pipeline.core.options import constraints_of
    from trihedron.pipeline.core.registry import options_of, parameters_of_method

    hints, comments, ranges = get_type_hints(plugin), field_comments(plugin), constraints_of(plugin)
    options = []
    for option in options_of(plugin):
        default = option.default_factory() if callable(option.default_factory) else option.default
        options.append(
            {
                "name": option.name,
                "type": type_name(hints[option.name]),
                "default": _plain(default),
                "range": " and ".join(map(str, ranges.get(option.name, ()))),
                "doc": comments.get(option.name, ""),
            }
        )
    return {
        "name": name,
        "class": f"{plugin.__module__}.{plugin.__qualname__}",
        "doc": inspect.getdoc(plugin) or "",
        "inputs": parameters_of_method(slot, plugin),
        "parameters": options,
    }


def type_name(hint: Any) -> str:
    """Format a type as it is written in the code, without modules."""
    if isinstance(hint, type) and not hasattr(hint, "__args__"):
        return hint.__name__
    text = str(hint)
    for module in ("trihedron.pipeline.core.types.", "typing."):
        text = text.replace(module, "")
    return text


def _plain(value: Any) -> Any:
    """Convert a default to JSON: the name of an Enum member, tuples as lists."""
    if isinstance(value, Enum):
        return value.name
    return [_plain(item) for item in value] if isinstance(value, (tuple, list)) else value


def report_names(slots: list[dict[str, Any]], broken: dict[str, str]) -> str:
    """Format the slots for people: a line of names each, then a line for each package that does not load, with its error."""
    names = [[slot["name"], ", ".join("*" * plugin["default"] + plugin["name"] for plugin in slot["plugins"])] for slot in slots]
    lines = [table(names, "ll"), "", "trihedron plugins SLOT describes each, trihedron plugins SLOT PLUGIN its options"]
    return "\n".join([*lines, *(f"broken: {package} does not load: {cause}" for package, cause in broken.items())])


def report(slot: dict[str, Any]) -> str:
    """Format a slot for people: its contract, and a line for each plugin."""
    inputs = ", ".join(f"{name}: {kind}" for name, kind in slot["inputs"].items())
    lines = [f"{slot['name']}({inputs}) -> {slot['output']}", f"  {slot['summary']}"]
    lines += [f"  {'*' if plugin['default'] else ' '} {plugin['name']}: {first_sentence(plugin['doc'])}" for plugin in slot["plugins"]]
    return "\n".join([*lines, "", f"trihedron plugins {slot['name']} PLUGIN lists its options"])


def report_plugin(slot: str, plugin: dict[str, Any]) -> str:
    """Format a plugin for people: its documentation and options."""
    rows = [(f"{slot}.{p['name']}: {p['type']}", f"= {json.dumps(p['default'])}", p["range"], p["doc"]) for p in plugin["parameters"]]
    options = [f"  {line}" for line in table(rows).splitlines()] if rows else ["  no options"]
    return "\n".join([f"{slot}={plugin['name']}({', '.join(plugin['inputs'])})", "", plugin["doc"], "", *options])


def first_sentence(text: str) -> str:
    """Return the first paragraph of a docstring up to its first full stop (not that of "et al."), on one line."""
    paragraph = " ".join(text.split("\n\n")[0].split())
    return re.split(r"(?<!\bal)\.\s+(?=[A-Z`])", paragraph, maxsplit=1)[0].rstrip(".")
