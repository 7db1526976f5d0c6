"""Hydra's options `slot=name`: the configuration of each plugin, made when it is asked for.

Hydra copies its ConfigStore with every composition; to convert and copy the configurations of all plugins takes as long as a short run.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar, get_type_hints

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from trihedron.pipeline.core.registry import find_plugin, load_plugins, options_of, plugin_class, plugins_of
from trihedron.pipeline.core.slots import SLOTS

PLUGIN_KEY = "plugin"  # which plugin a slot's configuration belongs to
SCHEME = "trihedron"


class PluginConfigs(ConfigSource):
    """Source of one group for each slot, with one configuration for each plugin. Processes of a sweep are sent a copy."""

    offered: ClassVar[Mapping[str, DictConfig]] = {}  # by slot: the configuration of its plugin in a recording

    def __init__(self, provider: str, path: str) -> None:
        super().__init__(provider, path)
        self.recorded = self.offered

    @staticmethod
    def scheme() -> str:
        return SCHEME

    def available(self) -> bool:
        return True

    def is_group(self, config_path: str) -> bool:
        return config_path.rstrip("/") in SLOTS

    def is_config(self, config_path: str) -> bool:
        slot, name = _parts(config_path)
        return slot in SLOTS and find_plugin(slot, name) is not None

    def load_config(self, config_path: str) -> ConfigResult:
        slot, name = _parts(config_path)
        recorded = self.recorded.get(slot)
        if recorded is not None and recorded[PLUGIN_KEY] == name:
            node = copy.deepcopy(recorded)
        else:
            node = plugin_config(name, plugin_class(slot, name))
        return ConfigResult(provider=self.provider, path=self.full_path(), config=node, header={"package": None})

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        slot = config_path.rstrip("/")
        if not slot:
            return [] if results_filter == ObjectType.CONFIG else sorted(SLOTS)
        if results_filter == ObjectType.GROUP or slot not in SLOTS:
            return []
        load_plugins()
        return list(plugins_of(slot))


class PluginSearchPath(SearchPathPlugin):
    """Entry of Hydra's search path for the configurations of plugins."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        search_path.prepend(provider=SCHEME, path=f"{SCHEME}://")


def offer_plugins(recorded: Mapping[str, Mapping[str, Any]]) -> None:
    """Let Hydra find the configurations of all plugins, with the options of a recording, by slot, instead of the defaults."""
    for kind in (PluginConfigs, PluginSearchPath):
        Plugins.instance().register(kind)
    kinds = {slot: _option_type(options[PLUGIN_KEY], plugin_class(slot, options[PLUGIN_KEY])) for slot, options in recorded.items()}
    PluginConfigs.offered = {slot: OmegaConf.structured(with_defaults(kind, recorded[slot])) for slot, kind in kinds.items()}


def with_defaults(node: type[Any], values: Mapping[str, Any]) -> type[Any]:
    """Return the dataclass with other defaults."""
    hints = get_type_hints(node)
    fields: list[Any] = [(name, hints[name], dataclasses.field(default_factory=partial(copy.deepcopy, value))) for name, value in values.items()]
    return dataclasses.make_dataclass(node.__name__, fields, bases=(node,))


def _option_type(name: str, plugin: type[Any]) -> type[Any]:
    """Return the unfrozen twin of a plugin that Hydra wants (a frozen dataclass would be a read-only node), with the plugin's name."""
    hints = get_type_hints(plugin)
    fields: list[Any] = [(PLUGIN_KEY, str, dataclasses.field(default=name))]
    for option in options_of(plugin):
        made = option.default_factory is not dataclasses.MISSING
        default = dataclasses.field(default_factory=option.default_factory) if made else dataclasses.field(default=option.default)
        fields.append((option.name, hints[option.name], default))
    return dataclasses.make_dataclass(plugin.__name__, fields)


_NODES: dict[tuple[str, type[Any]], DictConfig] = {}


def plugin_config(name: str, plugin: type[Any]) -> DictConfig:
    """Return the configuration of a plugin with its defaults, typed; a copy, because Hydra changes what it is given."""
    if (name, plugin) not in _NODES:
        _NODES[name, plugin] = OmegaConf.structured(_option_type(name, plugin))
    return copy.deepcopy(_NODES[name, plugin])


def _parts(config_path: str) -> tuple[str, str]:
    """Slot and plugin's name of a path of Hydra's; the name is empty for a path of another form."""
    slot, _, name = config_path.removesuffix(".yaml").partition("/")
    return slot, name
