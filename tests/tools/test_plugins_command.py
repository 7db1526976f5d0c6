"""`trihedron plugins`: every slot and plugin, with defaults and the comments of the fields."""

import json
import sys
from dataclasses import dataclass, make_dataclass
from enum import Enum
from typing import Annotated

import pytest

from trihedron.pipeline.app.cli import main
from trihedron.pipeline.core.comments import field_comments
from trihedron.pipeline.core.options import Range
from trihedron.pipeline.core.slots import SLOTS
from trihedron.pipeline.core.types import Frame, Normals
from trihedron.tools.plugins import describe_plugin, first_sentence


class Kind(Enum):
    fine = 1
    coarse = 2


@dataclass(frozen=True)
class Example:
    """Normals of an example. More of it.

    And a paragraph."""

    radius_px: Annotated[int, Range(1, 9)] = 3  # of the patch
    kind: Kind = Kind.coarse
    weights: tuple[float, ...] = (1.0, 2.0)  # centre, border

    def __call__(self, frame: Frame) -> Normals | None:
        radius: str = "local"  # no comment of a field
        assert radius
        return None


def described(capsys, *words):
    assert main(["plugins", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)["slots"]


def test_every_slot_is_described(capsys):
    slots = {slot["name"]: slot for slot in described(capsys)}
    assert list(slots) == list(SLOTS)
    assert slots["segments"]["inputs"] == {"frame": "Frame", "lines": "LineSegments"}
    assert slots["manhattan"]["inputs"]["previous"] == "ManhattanFrame | None"
    assert slots["manhattan"]["output"] == "ManhattanFrame"
    assert slots["surface"]["fold"]
    assert all(slot["summary"] and slot["doc"] for slot in slots.values())


def test_every_plugin_has_documentation_and_defaults(capsys):
    for slot in described(capsys):
        built_in = [plugin for plugin in slot["plugins"] if plugin["class"].startswith("trihedron.")]  # other tests register plugins of their own
        assert built_in
        for plugin in built_in:
            assert plugin["doc"], plugin
            assert set(plugin["inputs"]) <= {*slot["inputs"], "rng", "camera"}
            assert all(set(option) == {"name", "type", "default", "range", "doc"} for option in plugin["parameters"])


def test_one_slot_as_text(capsys):
    assert main(["plugins", "keypoints"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "keypoints(frame: Frame) -> Keypoints"
    assert any(line.startswith("  * orb: ") for line in lines) and len(lines) < 20
    assert lines[-1] == "trihedron plugins keypoints PLUGIN lists its options"


def test_names_alone(capsys):
    assert main(["plugins"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[: len(SLOTS)]] == list(SLOTS) and len(lines) == len(SLOTS) + 2
    assert "*mean_shift" in lines[list(SLOTS).index("manhattan")] and max(map(len, lines)) < 200


def test_one_plugin_as_text(capsys):
    assert main(["plugins", "keypoints", "orb"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("keypoints=orb(frame")
    assert any(line.split() == ["keypoints.features:", "int", "=", "1000", "at", "least", "1", "most", "key", "points", "kept"] for line in lines)
    assert len(described(capsys, "keypoints", "orb")[0]["plugins"]) == 1
    assert main(["plugins", "keypoints", "orp"]) == 2
    assert capsys.readouterr().err == "trihedron: plugins: the slot 'keypoints' has no plugin 'orp'; did you mean 'orb'?\n"


def test_a_plugin_as_data():
    found = describe_plugin("normals", "example", Example)
    assert found["class"].endswith("test_plugins_command.Example")
    assert found["doc"].startswith("Normals of an example. More of it.")
    assert found["inputs"] == ["frame"]
    assert found["parameters"] == [
        {"name": "radius_px", "type": "int", "default": 3, "range": "within 1 … 9", "doc": "of the patch"},
        {"name": "kind", "type": "Kind", "default": "coarse", "range": "", "doc": ""},
        {"name": "weights", "type": "tuple[float, ...]", "default": [1.0, 2.0], "range": "", "doc": "centre, border"},
    ]


def test_a_plugin_without_source_has_no_comments():
    assert field_comments(make_dataclass("Made", [("x", int, 1)])) == {}


def test_first_sentence():
    assert first_sentence("Found by (Handa et al. 2014) and others.\nThen more. And more.") == "Found by (Handa et al. 2014) and others"


def test_unknown_slot(capsys):
    assert main(["plugins", "manhatan"]) == 2
    assert capsys.readouterr().err == "trihedron: plugins: there is no slot 'manhatan'; did you mean 'manhattan'?\n"


@pytest.mark.parametrize("command", ["evaluate", "plugins", "topics", "convert"])
def test_help_of_each_command(capsys, command):
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    module = sys.modules[f"trihedron.tools.{command}"]
    out = capsys.readouterr().out
    assert module.__doc__.splitlines()[0] in out
    assert f"Example: trihedron {command} " in out
