"""Configurations of runs as the options that are not their defaults."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from omegaconf import OmegaConf

from trihedron.pipeline.core.config import compose_run
from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.plugin_configs import PLUGIN_KEY
from trihedron.pipeline.run.results import flatten_dict
from trihedron.tools.run_pages import RunFacts

NOT_SHOWN = ("out",)
NONE, DEFAULT = "-", " (default)"


def changed_options(runs: Mapping[str, RunFacts]) -> dict[str, Any]:
    """Return a table with a row for each option that is not its default in every run: the plugins of the run's graph are, and the values that its own
    plugins begin with."""
    values = {name: _flat_options(facts.graph, facts.config) for name, facts in runs.items()}
    defaults = {name: _defaults_of(facts) for name, facts in runs.items()}
    keys = dict.fromkeys(key for found in values.values() for key in found if key not in NOT_SHOWN)
    changed = [key for key in sorted(keys) if any(key in values[name] and values[name][key] != defaults[name].get(key, NONE) for name in runs)]
    rows = [[key, *(_cell(key, values[name], defaults[name]) for name in runs)] for key in changed]
    note = f"Options that differ from their defaults; {NONE} where a plugin has no such option."
    return {"title": "Configurations", "note": note, "header": ["option", *runs], "rows": rows}


def _cell(key: str, values: Mapping[str, str], defaults: Mapping[str, str]) -> str:
    return NONE if key not in values else values[key] + DEFAULT * (values[key] == defaults.get(key))


def _flat_options(graph: str, config: Mapping[str, Any]) -> dict[str, str]:
    """Return the options of a composed configuration by key; a slot's name is the key of its plugin, `graph` that of the graph."""
    flat = {key.removesuffix(f".{PLUGIN_KEY}"): _text(value) for key, value in flatten_dict(dict(config)).items()}
    return {"graph": graph, **flat}


def _text(value: Any) -> str:
    """Return a value as the command line takes it."""
    return f"[{','.join(map(_text, value))}]" if isinstance(value, list) else str(value)


def _defaults_of(facts: RunFacts) -> dict[str, str]:
    """Return the defaults of a run: plugins of its graph, and options of its own plugins; nothing where there is no such graph or plugin now."""
    chosen = {slot: str(options[PLUGIN_KEY]) for slot, options in facts.config.items() if isinstance(options, dict) and PLUGIN_KEY in options}
    try:
        plugins = _composed(facts.graph)
        other = {slot: name for slot, name in chosen.items() if plugins.get(slot) != name}
        words = [f"{'' if slot in plugins else '+'}{slot}={name}" for slot, name in other.items()]
        return _composed(facts.graph, *words) | {slot: plugins.get(slot, NONE) for slot in other}
    except TrihedronError:
        return {}


@cache
def _composed(graph: str, *words: str) -> dict[str, str]:
    config: Any = OmegaConf.to_container(compose_run([f"graph={graph}", *words]), enum_to_str=True)
    return _flat_options("structural", config)
