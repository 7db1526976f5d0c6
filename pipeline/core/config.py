"""Configuration by Hydra: the plugins' own fields, the graph files in `conf/`, and the root keys of a run.

Every registered plugin becomes an option `slot=name` of a typed group; its fields are validated by OmegaConf and once more by the plugin itself.
Hydra's many-line errors are rewritten as one line.
"""

from __future__ import annotations

import dataclasses
import re
import shlex
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from enum import Enum
from importlib.resources import files
from typing import Any, get_type_hints

from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ValidationError

from trihedron.pipeline.core.errors import ConfigError, TrihedronError, UsageError, did_you_mean
from trihedron.pipeline.core.graph import Graph, build_graph
from trihedron.pipeline.core.libraries import library_error
from trihedron.pipeline.core.options import constraints_of
from trihedron.pipeline.core.overrides import closing_brackets, with_literal_paths
from trihedron.pipeline.core.plugin_configs import PLUGIN_KEY, offer_plugins, with_defaults
from trihedron.pipeline.core.registry import cure_of_unknown, load_packages, load_plugins, options_of, plugin_class, plugins_of
from trihedron.pipeline.core.slots import SLOTS, Localising, default_wires

RECORDED_GRAPH = "recorded"  # in a replay: the option of `graph` with the wires of the recording
SWEEPER, SEARCH, DASK = (f"hydra_plugins.trihedron.{name}" for name in ("Sweeper", "Search", "Dask"))  # `_target_` of Hydra's groups
KINDS: dict[Any, str] = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}  # types of options, in words
_COMPOSING = threading.Lock()  # Hydra has one state, and one ConfigStore, for the whole process


class Feedback(Enum):
    """Inputs of recomputed stages in a replay, where these come from recomputed stages too: the new values, or the recorded ones."""

    new = "new"
    recorded = "recorded"


@dataclasses.dataclass
class RecordOptions:
    """`topics`: names of dense topics to record besides all others. `frames` embeds the input frames, lossless."""

    topics: list[str] = dataclasses.field(default_factory=list)
    frames: bool = False


@dataclasses.dataclass
class FoxgloveView:
    """`view=foxglove`: a WebSocket server."""

    viewer: str = "foxglove"
    port: int = 8765
    host: str = "127.0.0.1"  # the address to listen on: this machine alone; 0.0.0.0 lets everybody on the network look
    keep: bool = True  # serve after the last frame too, until Ctrl-C or SIGTERM (of trihedron run; a sweep does not)


@dataclasses.dataclass
class RerunView:
    """`view=rerun`: opens the viewer, or with `web=true` serves it to a browser."""

    viewer: str = "rerun"
    port: int = 9876  # of the data
    web: bool = False
    web_port: int = 9090
    host: str = "127.0.0.1"  # the address to listen on: this machine alone; 0.0.0.0 lets everybody on the network look, and log
    keep: bool = True  # serve the page after the last frame too, until Ctrl-C or SIGTERM (of trihedron run; a sweep does not)


VIEWS = {"foxglove": FoxgloveView, "rerun": RerunView}


@dataclasses.dataclass
class RunOptions:
    """The root keys of a run, besides one group for each slot (`trihedron plugins` lists them)."""

    defaults: list[Any] = dataclasses.field(
        default_factory=lambda: [
            "_self_",
            {"dataset": "synthetic"},
            {"graph": "structural"},
            {"experiment": None},
            {"without": None},
            {"view": None},
            {"override hydra/job_logging": "none"},
            {"override hydra/hydra_logging": "none"},
            {"override hydra/launcher": "joblib"},
            {"override hydra/sweeper": "trihedron"},
        ]
    )
    graph: dict[str, Any] = dataclasses.field(default_factory=lambda: {slot: _default_wiring(slot) for slot in SLOTS})  # all wires, by stage
    out: str = "runs/${now:%Y-%m-%d}/${now:%H-%M-%S}"  # the run folder
    threads: int = 2
    seed: int = 0
    outputs: list[str] = dataclasses.field(default_factory=lambda: ["trajectory"])
    replay: str = ""  # a recording to read topics from
    only: list[str] = dataclasses.field(default_factory=list)  # stages that a replay computes again; [] = all
    feedback: Feedback = Feedback.new
    report: str = ""  # a command that is given the folder of a sweep when all its jobs are done, for example: benchmark methods
    dry_run: bool = False  # of a sweep: say which jobs it has, and run none
    sequences: list[str] = dataclasses.field(default_factory=list)  # of a sweep: KIND:FOLDER and options after blanks, see sweep.words_of_sequence
    alternatives: list[str] = dataclasses.field(default_factory=list)  # of a sweep: words tried one at a time, see sweep.words_of_alternatives
    record: RecordOptions = dataclasses.field(default_factory=RecordOptions)
    save_map: str = ""  # write the map, and all that is needed to go on, to this file
    load_map: str = ""  # go on from such a file
    localise_only: bool = False  # the loaded map stays as it is
    calibrate: bool = False  # track the sequence once before, and run with the camera that it shows
    live: bool = False  # frames come at the camera's rate, and those for which the run comes too late are dropped
    budget_ms: float | None = None  # mean time from when a frame is there to its pose; above it the words of budget_order hold, one after the other
    budget_order: list[str] = dataclasses.field(default_factory=list)  # [] = budgets.USUAL
    view: Any = None  # show the run while it goes on: foxglove or rerun
    real_time: bool = False  # frames come at the camera's rate, none is dropped
    hydra: Any = dataclasses.field(
        default_factory=lambda: {"run": {"dir": "${out}"}, "sweep": {"dir": "${out}", "subdir": "${hydra.job.num}"}, "output_subdir": ".hydra"}
    )


@dataclasses.dataclass
class SearchOptions:
    """hydra.sweeper of `hydra/sweeper=optuna`: see pipeline/search.py."""

    _target_: str = SEARCH
    trials: int = 30  # besides the default configuration
    batch: int = 2  # trials chosen at once, without knowing each other's value, and so run side by side
    objective: str = "final.ate_rmse_m"  # a key of metrics.json
    direction: str = "minimize"  # or maximize
    seed: int = 0  # of the sampler
    params: Any = None  # overrides, as of any sweeper


@dataclasses.dataclass(frozen=True)
class RecordedConfig:
    """Checked values of a recording: options by slot (`plugin` among them), wires by stage (None: not recorded), and root keys. Text is escaped, so
    that OmegaConf interpolates nothing in it. `recorded_config.recorded_config` makes one."""

    options: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    graph: Mapping[str, Mapping[str, str | None]] | None = None
    root: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def register_configs(recorded: RecordedConfig | None = None) -> None:
    """Let Hydra know every plugin, and put the rest into its ConfigStore; call `registry.load_packages` first.

    The values of a recording take the place of the defaults: of its plugins' options, of the root keys, and of the graph, as `graph=recorded`."""
    store, recorded = ConfigStore.instance(), recorded or RecordedConfig()
    offer_plugins(recorded.options)
    chosen = {slot: options[PLUGIN_KEY] for slot, options in recorded.options.items()}
    for name, options in VIEWS.items():
        store.store(group="view", name=name, node=options)
    store.repo.get("graph", {}).pop(f"{RECORDED_GRAPH}.yaml", None)
    choices = {"dataset": chosen.get("dataset", "synthetic"), "graph": "structural"}
    if recorded.graph is not None:
        choices["graph"] = RECORDED_GRAPH
        stages = [{f"/{slot}": name} for slot, name in chosen.items() if slot != "dataset"]
        outputs = {"outputs": recorded.root["outputs"]} if "outputs" in recorded.root else {}
        content = {"defaults": [*stages, "_self_"], "graph": dict(recorded.graph), **outputs}
        store.store(group="graph", name=RECORDED_GRAPH, package="_global_", node=content)
    slots = [(slot, Any, dataclasses.field(default=None)) for slot in SLOTS]
    plain = RunOptions().defaults
    defaults = [{key: choices.get(key, value) for key, value in entry.items()} if isinstance(entry, dict) else entry for entry in plain]
    store.store(group="hydra/sweeper", name="trihedron", node={"_target_": SWEEPER, "params": None})
    store.store(group="hydra/sweeper", name="optuna", node=SearchOptions)
    store.store(group="hydra/launcher", name="dask", node={"_target_": DASK, "address": ""})
    root = dataclasses.make_dataclass("Root", slots, bases=(RunOptions,))
    values = {key: RecordOptions(**value) if key == "record" else value for key, value in recorded.root.items()}
    store.store(name="root", node=with_defaults(root, {**values, "defaults": defaults}))


def _default_wiring(slot: str) -> dict[str, str]:
    return {parameter: str(wire) for parameter, wire in default_wires(slot).items()}


def graph_of(config: DictConfig) -> Graph:
    """Build the checked graph of a composed configuration, and its plugins. Raises ConfigError or GraphError, one line each."""
    for slot in SLOTS:
        if isinstance(chosen := config.get(slot), str):
            raise ConfigError(slot, "this graph has no such stage", f"add it with +{slot}={chosen}, or choose another graph")
    wiring: Any = OmegaConf.to_container(config.graph, resolve=True)
    if (stage := next((stage for stage, inputs in wiring.items() if not isinstance(inputs, dict)), None)) is not None:
        raise ConfigError(f"graph.{stage}", f"'{wiring[stage]}' is not the wires of a stage", f"choose a plugin with {stage}=NAME")
    plugins = {slot: make_plugin(slot, config[slot]) for slot in wiring if slot in SLOTS and config.get(slot) is not None}
    if config.localise_only:
        if "map" in plugins and not isinstance(plugins["map"], Localising):
            raise ConfigError("localise_only", f"map={config.map.plugin} cannot leave a loaded map as it is", "choose another plugin, or map=none")
        plugins = {slot: plugin.localising() if isinstance(plugin, Localising) else plugin for slot, plugin in plugins.items()}
    return build_graph(plugins, list(config.outputs), {stage: wires for stage in wiring if (wires := _changed_wires(stage, wiring[stage]))})


def _changed_wires(stage: str, wires: dict[str, str | None]) -> dict[str, str | None]:
    """Return the wires of a stage that differ from its slot's defaults; one that was deleted (`~graph.STAGE.INPUT`) is None: not wired."""
    default = _default_wiring(stage) if stage in SLOTS else {}
    return {parameter: wires.get(parameter) for parameter in {**default, **wires} if wires.get(parameter) != default.get(parameter)}


def default_plugins() -> dict[str, str]:
    """Return slot -> plugin of `graph=structural` and of the root configuration."""
    graph: Any = OmegaConf.create((files("trihedron.conf") / "graph" / "structural.yaml").read_text())
    chosen = [*RunOptions().defaults, *graph.defaults]
    return {str(slot).lstrip("/"): str(plugin) for entry in chosen if not isinstance(entry, str) for slot, plugin in entry.items()}


def make_plugin(slot: str, options: DictConfig) -> Any:
    """The plugin a slot's options describe; lists become tuples. Raises ConfigError naming the option that is out of range."""
    values: Any = OmegaConf.to_container(options, resolve=True)
    name = values.pop(PLUGIN_KEY)
    kind = plugin_class(slot, name)
    try:
        return kind(**{option: tuple(value) if isinstance(value, list) else value for option, value in values.items()})
    except (ValueError, TypeError) as error:
        field, _, cause = str(error).partition(": ")
        place, cause = (f"{slot}.{field}", cause) if cause and field.isidentifier() else (slot, str(error))
        raise ConfigError(place, cause, f"see trihedron plugins {slot} {name}") from error


def is_key(name: str) -> bool:
    """Say if a name begins as a key of a run does, as `out`, `planes` or `dataset.length`."""
    return bool(re.fullmatch(r"\w+(\.\w+)*", name)) and name.partition(".")[0] in _root_keys()


def is_switch(key: str) -> bool:
    """Say if a root key is true or false."""
    return get_type_hints(RunOptions).get(key) is bool


def _root_keys() -> set[str]:
    return {f.name for f in dataclasses.fields(RunOptions) if f.name != "defaults"} | set(SLOTS) | {"experiment", "without"}


def check_added(overrides: Iterable[str]) -> None:
    """Hydra lets `+key=value` add any key, and nobody would read it. Raises UsageError for a key that no run has."""
    known = _root_keys()
    for word in overrides:
        if (added := re.match(r"\+{1,2}([^=@]*)", word)) is not None and (root := re.split(r"[./]", added[1])[0]) not in known:
            cure = did_you_mean(root, known)
            raise UsageError(added[1], "there is no such key to add to", cure if cure.startswith("did") else "see trihedron run --help")


def compose_run(overrides: Iterable[str], recorded: RecordedConfig | None = None) -> DictConfig:
    """Compose the configuration that `trihedron run` makes of these overrides, over the values of a recording. Raises TrihedronError, one line."""
    return composed_each([overrides], recorded)[0]


def composed_each(overrides: Iterable[Iterable[str]], recorded: RecordedConfig | None = None) -> list[DictConfig]:
    """Compose one configuration for each list of overrides; other threads wait. Raises TrihedronError, one line."""
    load_packages()
    with _COMPOSING, _hydra_of_the_caller_set_aside():
        register_configs(recorded)
        try:
            with initialize_config_module("trihedron.conf", version_base="1.3"):
                return [compose("root", overrides=with_literal_paths(words)) for words in overrides]
        except Exception as error:
            raise rewrite_error(error) from error


@contextmanager
def _hydra_of_the_caller_set_aside() -> Iterator[None]:
    """Let the block initialise Hydra within a program that has done so itself (`@hydra.main`)."""
    own = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        GlobalHydra.instance().clear()
        if own is not None:
            GlobalHydra.instance().initialize(own)


def rewrite_error(error: Exception) -> TrihedronError:
    """Rewrite an error that Hydra or OmegaConf raises while composing as one line with place, cause and cure."""
    text = " ".join(str(error).split())
    cause: BaseException = error.__cause__ or error
    if isinstance(cause, ModuleNotFoundError) and cause.name:
        return library_error(cause.name.partition(".")[0], cause)
    if match := re.search(r"Ambiguous value for argument '([^=']*)=([^']*)'", text):
        return UsageError(match[1], f"'{match[2]}' is several values", "add -m to run once with each, or write a list as [A,B]")
    if isinstance(error, OverrideParseException) and (closing := closing_brackets(error.override)):
        closed = shlex.quote(error.override.rstrip(", ") + closing)
        return UsageError(error.override, f"lacks {closing} at its end", f"write {closed}")
    if isinstance(error, OverrideParseException):
        return UsageError(error.override, "is not an override", "write key=value, for example threads=1 (quote lists: 'only=[pose]')")
    if isinstance(error, MissingConfigException) and (match := re.search(r"Could not find '([\w/]+)/([^'/]*)'", text)):
        return _unknown_option(match[1], match[2], list(error.options or []))
    if match := re.search(r"Could not override '([\w./]+)'", text):
        return _unknown_key(match[1], getattr(cause, "object_type", None))
    if isinstance(cause, ValidationError) and "is not a ListConfig" in str(cause):
        return ConfigError(str(getattr(cause, "full_key", "")), "is not a list", "write it as [A,B], quoted for the shell")
    if isinstance(cause, ValidationError):
        return _wrong_type(cause, text)
    if isinstance(error, OSError):
        return ConfigError("out", f"the folder cannot be made: {error.strerror}: {error.filename}", "give another out=FOLDER")
    place = str(getattr(cause, "full_key", "") or "configuration")
    return ConfigError(place, text.partition(" full_key")[0], "see trihedron run --help")


def _wrong_type(error: ValidationError, text: str) -> ConfigError:
    """Return the error of a value of another type than its option's: the kind, range and default of that."""
    key = str(error.full_key or text.partition("=")[0].rpartition(" ")[2])
    owner: Any = error.object_type
    slot, constraints, cure = key.partition(".")[0], "", "see trihedron run --help"
    if slot in SLOTS and isinstance(error.parent_node, DictConfig) and PLUGIN_KEY in error.parent_node:
        owner = plugin_class(slot, name := str(error.parent_node[PLUGIN_KEY]))
        constraints, cure = " and ".join(map(str, constraints_of(owner).get(str(error.key), ()))), f"see trihedron plugins {slot} {name}"
    kind = get_type_hints(owner).get(str(error.key)) if dataclasses.is_dataclass(owner) else None
    if isinstance(kind, type) and issubclass(kind, Enum):
        permitted = "one of " + ", ".join(kind.__members__)
    elif kind in KINDS:
        permitted = KINDS[kind] + (f" that is {constraints}" if constraints else "")
    else:
        return ConfigError(key, reason_of(error), "give a value of that type")
    default = next(option.default for option in dataclasses.fields(owner) if option.name == error.key)
    shown = default.name if isinstance(default, Enum) else str(default).lower() if isinstance(default, bool) else default
    given = "null" if error.value is None else error.value
    return ConfigError(key, f"'{given}' is not {permitted} (default {shown})", cure)


def reason_of(error: BaseException) -> str:
    """Return why OmegaConf refuses a value, in one line without the place."""
    return " ".join(str(getattr(error, "msg", None) or error).split()).partition(" full_key")[0]


def _unknown_option(group: str, name: str, options: list[str]) -> TrihedronError:
    if name.startswith("submitit"):
        return library_error("hydra_plugins.hydra_submitit_launcher")
    if group in SLOTS:
        return ConfigError(group, f"there is no plugin '{name}' for the slot '{group}'", cure_of_unknown(group, name))
    return ConfigError(group, f"there is no {group} '{name}'", did_you_mean(name, options))


def _unknown_key(key: str, owner: Any) -> TrihedronError:
    """Return the error of a key that its `owner`, the dataclass of its group, has not."""
    group, _, option = key.rpartition(".")
    if group in SLOTS:
        load_plugins()
        return ConfigError(key, f"the chosen plugin has no option '{option}'", _cure_of_option(group, option, plugins_of(group)))
    if group == "view":
        viewer = next((name for name, kind in VIEWS.items() if kind is owner), "")
        if viewer:
            return ConfigError(key, f"view={viewer} has no option '{option}'", _cure_of_option(group, option, VIEWS))
        return ConfigError(key, "no viewer with this option is chosen", f"give view={' or view='.join(VIEWS)} too")
    known = {f.name for f in dataclasses.fields(RunOptions) if f.name not in ("defaults", "hydra")} | set(SLOTS)
    first = key.partition(".")[0]
    return ConfigError(key, "there is no such key", did_you_mean(first, known) if first not in known else "see trihedron run --help")


def _cure_of_option(group: str, option: str, owners: Mapping[str, type[Any]]) -> str:
    """Return the cure for an option that the chosen one of a group's `owners` has not: which ones have it, else the closest name there is."""
    options = {name: {f.name for f in options_of(owner)} for name, owner in owners.items()}
    having = sorted(name for name, known in options.items() if option in known)
    return (
        f"it belongs to {group}={' or '.join(having)}" if having else did_you_mean(option, {known for names in options.values() for known in names})
    )
