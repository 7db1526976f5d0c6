"""The composed configuration of a recording, taken as data.

A recording comes from anyone. Its metadata `config` is YAML: for each slot the name of a registered plugin and values of its options, the wires
`graph`, and a few root keys. Those become defaults that the command line changes. Nothing else is taken: no group, no path to configuration, no
interpolation, nothing of Hydra's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from trihedron.pipeline.core.config import RecordedConfig, RunOptions, make_plugin, reason_of
from trihedron.pipeline.core.errors import RecordingError, TrihedronError
from trihedron.pipeline.core.files import YamlError, parse_yaml
from trihedron.pipeline.core.overrides import literal_text
from trihedron.pipeline.core.plugin_configs import PLUGIN_KEY, plugin_config
from trihedron.pipeline.core.registry import load_packages, plugin_class
from trihedron.pipeline.core.renamed import current_option, current_plugin
from trihedron.pipeline.core.slots import SLOTS

ROOT_KEYS = (
    "seed",
    "outputs",
    "record",
    "load_map",
    "localise_only",
    "budget_ms",
    "budget_order",
)  # of a run, besides slots and wires, that a replay takes
MAX_CHARACTERS = 200_000  # of the YAML; a full configuration has 6 000
MAX_DEPTH = 8  # of nested lists and mappings; a configuration has 3
SHOWN = 60  # characters of a stranger's text in a message
CURE = "the file is damaged or of another version; record again"


def recorded_config(text: str, place: str) -> RecordedConfig:
    """Check the YAML `text` of the recording `place`: known options of registered plugins, each of its type and within its range.

    Raises RecordingError, one line, for anything else; keys that a replay does not take are ignored."""
    load_packages()
    content = _parse_mapping(text, place)
    options = {slot: _options(content[slot], slot, place) for slot in SLOTS if content.get(slot) is not None}
    graph = _graph(content["graph"], place) if content.get("graph") is not None else None
    node = OmegaConf.structured(RunOptions)
    root = {key: _convert_value(node, key, content[key], key, place) for key in ROOT_KEYS if key in content}
    return RecordedConfig(options, graph, root)


def _parse_mapping(text: str, place: str) -> Mapping[str, Any]:
    """The mapping in YAML of limited length and depth, without aliases."""
    if len(text) > MAX_CHARACTERS:
        raise RecordingError(place, f"has a configuration of {len(text)} characters, more than {MAX_CHARACTERS}", CURE)
    try:
        content = parse_yaml(text, MAX_DEPTH) or {}
    except YamlError as error:
        raise RecordingError(place, f"has a configuration {error}", CURE) from error
    if not isinstance(content, dict):
        raise RecordingError(place, "has a configuration that is not a mapping", CURE)
    return content


def _options(given: Any, slot: str, place: str) -> Mapping[str, Any]:
    """The options of a slot's plugin."""
    if not isinstance(given, dict) or not isinstance(given.get(PLUGIN_KEY), str):
        raise RecordingError(place, f"was made with '{slot}: {_abbreviate(given)}', which names no plugin", CURE)
    name = current_plugin(slot, given[PLUGIN_KEY])
    try:
        node = plugin_config(name, plugin_class(slot, name))
    except TrihedronError as error:
        cause = f"was made with {slot}={_abbreviate(name)}, and there is no such plugin for the slot '{slot}'"
        raise RecordingError(place, cause, "install the package that has it") from error
    for key, value in given.items():
        key = current_option(slot, name, key) if isinstance(key, str) else key
        if key not in (PLUGIN_KEY, None):
            _convert_value(node, key, value, f"{slot}.{_abbreviate(key)}", place)
    try:
        make_plugin(slot, node)
    except Exception as error:  # of a third party's plugin anything, for a value that nobody would choose
        cause = f"{error.place}: {error.cause}" if isinstance(error, TrihedronError) else f"{slot}: {type(error).__name__}: {error}"
        raise RecordingError(place, f"was made with a value out of range: {_abbreviate(cause, 4 * SHOWN)}", CURE) from error
    plain: Any = OmegaConf.to_container(node, resolve=False)
    return dict(plain)


def _convert_value(node: DictConfig, key: Any, value: Any, name: str, place: str) -> Any:
    """Put a value into its typed node; returns it as converted there, its text escaped."""
    if not isinstance(key, str) or key not in node:
        raise RecordingError(place, f"was made with {name}, an option that this program does not have", CURE)
    try:
        node.merge_with({key: _literal(value)})
        plain: Any = OmegaConf.to_container(node, resolve=False)
    except (OmegaConfBaseException, ValueError, TypeError, OverflowError) as error:
        raise RecordingError(place, f"was made with {name}={_abbreviate(value)}: {_abbreviate(reason_of(error), 4 * SHOWN)}", CURE) from error
    return plain[key]


def _graph(given: Any, place: str) -> Mapping[str, Mapping[str, str | None]]:
    """The wires: stage -> input -> topic, all plain words."""
    if not isinstance(given, dict):
        raise RecordingError(place, f"was made with 'graph: {_abbreviate(given)}', which holds no wires", CURE)
    for stage, wires in given.items():
        words = [stage, *wires, *(wire for wire in wires.values() if wire is not None)] if isinstance(wires, dict) else [None]
        if not all(isinstance(word, str) and re.fullmatch(r"\w+(@\w+)?", word) for word in words):
            raise RecordingError(place, f"was made with 'graph.{_abbreviate(stage)}: {_abbreviate(wires)}', which are not wires", CURE)
    return {stage: dict(wires) for stage, wires in given.items()}


def _literal(value: Any) -> Any:
    """The value with all text escaped, so that OmegaConf takes it as it is."""
    if isinstance(value, dict):
        return {_literal(key): _literal(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_literal(item) for item in value]
    if value == "???":
        raise ValueError("a missing value")
    return literal_text(value) if isinstance(value, str) else value


def _abbreviate(value: Any, length: int = SHOWN) -> str:
    """A stranger's text in a message, shortened."""
    text = " ".join(str(value).split())
    return text if len(text) <= length else text[: length - 1] + "…"
