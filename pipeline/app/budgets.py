"""The budget that a configuration states: `budget_ms`, and in `budget_order` what is given up for it."""

from __future__ import annotations

import re
from dataclasses import fields

import yaml
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from trihedron.pipeline.core.config import graph_of, reason_of
from trihedron.pipeline.core.errors import ConfigError, did_you_mean
from trihedron.pipeline.core.graph import Graph, Stage
from trihedron.pipeline.core.plugin_configs import PLUGIN_KEY
from trihedron.pipeline.core.registry import plugin_class
from trihedron.pipeline.run.budget import Budget

PLACE = "budget_order"
WORD = re.compile(r"(\w+)(?:\.(\w+))?=([\w.+-]+)")  # a name, a number, true or false: no path
MOST_WORDS = 20
USUAL = ("keypoints.features=600", "bundle=none", "loop=none")  # those of them that fit a graph, where no order is given


def budget_of(config: DictConfig, graph: Graph) -> Budget | None:
    """Return the budget of a configuration and its graph; None without `budget_ms`. The usual order, where none is given, is written into the
    configuration, which a recording states. Raises ConfigError, one line, for words that cannot be taken."""
    if config.budget_ms is None:
        return None
    if not 0.0 < config.budget_ms < float("inf"):
        raise ConfigError("budget_ms", f"{config.budget_ms} is not a time", "give milliseconds, for example budget_ms=33")
    if not config.budget_order:
        config.budget_order = [word for word in USUAL if _fits(config, graph, word)]
    if not 1 <= len(config.budget_order) <= MOST_WORDS:
        raise ConfigError(PLACE, f"has {len(config.budget_order)} words", f"give 1 to {MOST_WORDS}, for example '{PLACE}=[bundle=none]'")
    config, stages = config.copy(), list[Stage]()
    for word in config.budget_order:
        stages.append(_changed_stage(config, graph, str(word)))
    return Budget(float(config.budget_ms), tuple(map(str, config.budget_order)), tuple(stages))


def _fits(config: DictConfig, graph: Graph, word: str) -> bool:
    """Say if a word of the usual order saves something of a graph."""
    key, _, value = word.partition("=")
    slot, _, option = key.partition(".")
    if slot not in graph.stages:
        return False
    return bool(config[slot].get(option, 0) > int(value) if option else config[slot][PLUGIN_KEY] != value)


def _changed_stage(config: DictConfig, graph: Graph, word: str) -> Stage:
    """Change the configuration by a word; returns the stage that it makes."""
    match = WORD.fullmatch(word)
    if match is None:
        raise ConfigError(PLACE, f"'{word}' is no STAGE=PLUGIN or STAGE.OPTION=VALUE", "give for example keypoints.features=500 or bundle=none")
    slot, option, value = match.groups()
    if slot not in graph.stages or graph.stages[slot].fold or slot == "dataset":
        known = [name for name, stage in graph.stages.items() if not stage.fold and name != "dataset"]
        cause = "cannot be changed in mid-run" if slot in graph.stages else "is no stage of this graph"
        raise ConfigError(PLACE, f"{word}: '{slot}' {cause}", did_you_mean(slot, known))
    with open_dict(config):
        if option is None:
            plugin_class(slot, value)
            config[slot] = OmegaConf.create({PLUGIN_KEY: value})
        else:
            _set_option(config, slot, option, value, word)
    stage = graph_of(config).stages[slot]
    if not set(stage.inputs) <= set(graph.stages[slot].inputs):
        more = ", ".join(sorted(set(stage.inputs) - set(graph.stages[slot].inputs)))
        raise ConfigError(PLACE, f"{word}: it reads {more}, which {slot} does not before", "choose another plugin")
    return stage


def _set_option(config: DictConfig, slot: str, option: str, value: str, word: str) -> None:
    name = config[slot][PLUGIN_KEY]
    known = [field.name for field in fields(plugin_class(slot, name))]
    if option not in known:
        raise ConfigError(PLACE, f"{word}: {slot}={name} has no option '{option}'", did_you_mean(option, known))
    try:
        config[slot][option] = yaml.safe_load(value)
    except OmegaConfBaseException as error:
        raise ConfigError(PLACE, f"{word}: {reason_of(error)}", f"see trihedron plugins {slot} {name}") from error
