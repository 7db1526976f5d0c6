"""The README says what is there: its table of plugins is the registry's, and its commands exist."""

import re
from importlib.metadata import entry_points
from pathlib import Path

import yaml

from trihedron.pipeline.core.registry import load_plugins, plugins_of
from trihedron.pipeline.core.slots import SLOTS, summary

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
BEGIN, END = "<!-- plugins: written by tests/tools/test_readme.py -->\n", "<!-- end of plugins -->"


def plugin_table():
    """The table of built-in plugins, those of the default graph in bold."""
    load_plugins()
    graph = yaml.safe_load((ROOT / "conf" / "graph" / "structural.yaml").read_text())
    default = {key.strip("/"): name for entry in graph["defaults"] for key, name in entry.items()} | {"dataset": "synthetic"}
    lines = ["| slot | plugins (**default**) | gives |", "|---|---|---|"]
    for slot in SLOTS:
        built_in = [name for name, plugin in plugins_of(slot).items() if plugin.__module__.startswith("trihedron.")]
        names = [f"**`{default[slot]}`**", *(f"`{name}`" for name in built_in if name != default[slot])]
        lines.append(f"| `{slot}` | {', '.join(names)} | {summary(slot).rstrip('.')} |")
    return "\n".join(lines) + "\n"


def test_the_table_of_plugins_is_the_registry():
    assert README.split(BEGIN)[1].split(END)[0] == plugin_table()


def test_the_commands_of_the_readme_exist():
    known = {entry.name for entry in entry_points(group="trihedron.commands")} | {"run"}
    used = set(re.findall(r"^trihedron ([\w-]+)", README, re.MULTILINE)) | set(re.findall(r"`trihedron ([\w-]+)", README))
    assert used <= known and {"run", "plugins", "topics", "picture"} <= used


def test_no_picture_is_too_large():
    for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", README):
        assert (ROOT / name).stat().st_size < 300_000


if __name__ == "__main__":
    head, rest = README.split(BEGIN)
    (ROOT / "README.md").write_text(head + BEGIN + plugin_table() + END + rest.split(END, 1)[1])
