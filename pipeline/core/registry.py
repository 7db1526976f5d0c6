"""Plugins by slot and name, checked against their slot's contract when they register.

A built-in plugin registers when it is looked up: the module of `SLOT=NAME` is `trihedron.plugins.SLOT.NAME`, or has that name in a package of HOMES.
Only what lists plugins, and a name that is none of these, imports them all."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import pkgutil
import sys
import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from enum import Enum
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from trihedron.pipeline.core.drawings import Drawing
from trihedron.pipeline.core.errors import PluginError, TrihedronError, did_you_mean, printable
from trihedron.pipeline.core.libraries import library_error
from trihedron.pipeline.core.options import check_options
from trihedron.pipeline.core.slots import FOLDS, RESERVED, SLOTS, inputs_of, method_of, output_of, strip_none
from trihedron.pipeline.core.types import F64, Pose, Value

Plugin = TypeVar("Plugin", bound=type)
Key = TypeVar("Key")
Function = TypeVar("Function", bound=Callable[..., Any])
_PLUGINS: dict[str, dict[str, type[Any]]] = {slot: {} for slot in SLOTS}
_BUILT_IN = ("trihedron.datasets", "trihedron.plugins")
HOMES = {"dataset": ("trihedron.datasets.readers", "trihedron.datasets.simulation", "trihedron.datasets.faults")}
ENTRY_POINT_GROUP = "trihedron.plugins"
_BROKEN: dict[str, str] = {}  # packages and modules of plugins that do not load, and why
_LOADING = threading.RLock()
FileWriter = Callable[[Path, Any], list[str]]
FileCheck = Callable[[Path, Mapping[str, Any] | None], None]
CovariancePart = Callable[[Pose], F64]
DrawingOf = Callable[[Any], Drawing]
_COVARIANCES: dict[str, CovariancePart] = {}
_DRAWINGS: dict[type[Value], DrawingOf] = {}


@dataclass(frozen=True)
class FoldFiles:
    """Files of a fold's value in a run folder: `write` writes it and returns lines that describe it; `names` are those of all files that may come
    of it, later commands included; `check` raises TrihedronError where a run with these options of the stage, None without it, would lose what a user
    wrote there."""

    write: FileWriter
    names: frozenset[str]
    check: FileCheck | None = None


_FILES: dict[str, FoldFiles] = {}


def register(slot: str, name: str) -> Callable[[Plugin], Plugin]:
    """Register a frozen dataclass as the plugin `name` of `slot` (class decorator). Each construction then checks the ranges of its options.

    Args:
        slot: as "planes".
        name: the word of the command line that chooses it, as in `planes=mine`.

    Returns:
        The decorator, which returns the class.

    Raises:
        PluginError: from the decorator, naming the plugin and its file: the slot is unknown, the name is taken, the class is not a frozen dataclass,
            or its method's parameters or return type are not the slot's.
    """

    def decorate(plugin: Plugin) -> Plugin:
        place = f"plugin {slot}={name} ({_source_of(plugin)})"
        if slot not in SLOTS:
            raise PluginError(place, f"there is no slot '{slot}'", did_you_mean(slot, SLOTS))
        if not plugin.__module__.startswith(_BUILT_IN):
            _load_by_name(slot, name)  # so that nobody takes a built-in name
        known = _PLUGINS[slot].get(name)
        if known is not None and (known.__module__, known.__qualname__) != (plugin.__module__, plugin.__qualname__):
            raise PluginError(place, f"the name is taken by {_source_of(known)}", "register it under another name")
        params = getattr(plugin, "__dataclass_params__", None)
        if params is None or not params.frozen:
            raise PluginError(place, "is not a frozen dataclass", "put @dataclass(frozen=True) under @register")
        _check_contract(slot, plugin, place)
        _check_when_constructed(plugin)
        _PLUGINS[slot][name] = plugin
        return plugin

    return decorate


def _check_when_constructed(plugin: type) -> None:
    """Make each construction of a plugin take the names of enumerations' members, and raise ValueError for an option out of its range."""
    initialise = plugin.__init__  # type: ignore[misc]
    enums_once = functools.cache(functools.partial(_enums_of, plugin))

    @functools.wraps(initialise)
    def initialise_and_check(self: Any, *args: Any, **options: Any) -> None:
        enums = enums_once()
        initialise(self, *args, **{name: _member(name, enums[name], value) if name in enums else value for name, value in options.items()})
        check_options(self)

    plugin.__init__ = initialise_and_check  # type: ignore[misc]


def _enums_of(plugin: type[Any]) -> dict[str, type[Enum]]:
    """Return option -> its enumeration, for the options of a dataclass that have one."""
    return {name: hint for name, hint in get_type_hints(plugin).items() if isinstance(hint, type) and issubclass(hint, Enum)}


def _member(option: str, enum: type[Enum], value: Any) -> Enum:
    """Return the member of an enumeration that a name stands for, or that is given itself. Raises ValueError for anything else."""
    if isinstance(value, enum):
        return value
    if isinstance(value, str) and value in enum.__members__:
        return enum[value]
    close = did_you_mean(str(value), enum.__members__)
    raise ValueError(f"{option}: '{value}' is not one of {', '.join(enum.__members__)}" + (f"; {close}" if close.startswith("did") else ""))


def _source_of(plugin: type) -> str:
    try:
        return inspect.getsourcefile(plugin) or plugin.__module__
    except (TypeError, OSError):  # defined where there is no file
        return plugin.__module__


def _check_contract(slot: str, plugin: type, place: str) -> None:
    """Compare the plugin's method with the slot's: a subset of its parameters and the reserved ones, equal types, the slot's return type."""
    for method in ("start", "add", "finish") if slot in FOLDS else ("__call__",):
        if not any(method in vars(base) for base in plugin.__mro__):
            raise PluginError(place, f"has no method {method}", f"the slot '{slot}' needs it")
    method = method_of(slot)
    try:
        hints = get_type_hints(getattr(plugin, method))
    except NameError as error:
        raise PluginError(place, f"type hint of {method} not found: {error}", "import it outside TYPE_CHECKING") from error
    allowed = {**inputs_of(slot), **(RESERVED if slot != "dataset" else {})}
    for name in parameters_of_method(slot, plugin):
        if name not in allowed:
            raise PluginError(place, f"{method} takes '{name}', which the slot '{slot}' does not give", did_you_mean(name, allowed))
        if hints.get(name) != allowed[name]:
            raise PluginError(place, f"{method} takes '{name}' as {_show(hints.get(name))}", f"the slot gives {_show(allowed[name])}")
    returned = get_type_hints(getattr(plugin, "finish" if slot in FOLDS else "__call__")).get("return")
    if strip_none(returned) != output_of(slot):
        raise PluginError(place, f"returns {_show(returned)}", f"the slot '{slot}' returns {_show(output_of(slot))}")


def _show(hint: Any) -> str:
    if hint is None:
        return "nothing declared"
    return hint.__name__ if isinstance(hint, type) else str(hint).replace("trihedron.pipeline.core.types.", "")


def parameters_of_method(slot: str, plugin: type) -> list[str]:
    """Return the parameters a plugin takes, reserved ones included, in its own order."""
    names = inspect.signature(getattr(plugin, method_of(slot))).parameters
    return [name for name in names if name not in ("self", "state") and not (slot == "dataset" and name == "index")]


def check_value(slot: str, value: Any, index: int) -> None:
    """Raise TypeError or ValueError unless a plugin returned its slot's type, with the frame's index on it."""
    if not isinstance(value, output_of(slot)):
        raise TypeError(f"returned {type(value).__name__}, the slot's type is {output_of(slot).__name__}")
    if value.index != index:
        raise ValueError(f"returned a {type(value).__name__} of frame {value.index} at frame {index}")


def plugin_class(slot: str, name: str) -> type[Any]:
    """Return the class registered under slot and name. Raises PluginError with the closest names otherwise."""
    if slot not in SLOTS:
        raise PluginError(slot, f"there is no slot '{slot}'", did_you_mean(slot, SLOTS))
    found = find_plugin(slot, name)
    if found is None:
        raise PluginError(slot, f"there is no plugin '{name}' for the slot '{slot}'", cure_of_unknown(slot, name))
    return found


def find_plugin(slot: str, name: str) -> type[Any] | None:
    """Return the class registered under a slot and a name, importing its module if that is built in, else every plugin; None where there is none."""
    if name not in _PLUGINS[slot]:
        _load_by_name(slot, name)
    if name not in _PLUGINS[slot]:
        load_plugins()
    return _PLUGINS[slot].get(name)


def _load_by_name(slot: str, name: str) -> None:
    """Import the built-in module of a plugin, if there is one."""
    if name == "none":
        importlib.import_module("trihedron.plugins.none")
    elif name.isidentifier():
        for package in HOMES.get(slot, (f"trihedron.plugins.{slot}",)):
            importlib.import_module(package)
            if find_spec(f"{package}.{name}") is not None:
                importlib.import_module(f"{package}.{name}")
                return


def cure_of_unknown(slot: str, name: str) -> str:
    """Return the cure for a plugin's name that is unknown: the closest method, else all, and the packages of plugins that do not load, as it may be
    in one."""
    broken = [f"it may be in {package}, which does not load: {error}" for package, error in broken_packages().items()]
    close = did_you_mean(name, _PLUGINS[slot].keys() - {"none"})
    return "; ".join([close if close.startswith("did") else f"known: {', '.join(sorted(_PLUGINS[slot]))}", *broken])


def _register_in(known: dict[Key, Function], key: Key) -> Callable[[Function], Function]:
    """Keep a function under a key; the last one stays (decorator)."""

    def decorate(function: Function) -> Function:
        known[key] = function
        return function

    return decorate


def register_files(slot: str, names: Collection[str], check: FileCheck | None = None) -> Callable[[FileWriter], FileWriter]:
    """Register the function that writes the files of a fold's value into a run folder, as `FoldFiles.write` (decorator)."""

    def decorate(write: FileWriter) -> FileWriter:
        _FILES[slot] = FoldFiles(write, frozenset(names), check)
        return write

    return decorate


def write_files_of(slot: str, folder: Path, value: Any) -> list[str]:
    """Write the files of a fold's value into a folder; returns lines that describe them, none where the slot has no files."""
    if slot not in _FILES:
        load_plugins()
    return _FILES[slot].write(folder, value) if slot in _FILES else []


def files_of_folds() -> dict[str, FoldFiles]:
    """Return what each slot leaves in a run folder, for those that leave files there."""
    load_plugins()
    return dict(_FILES)


def register_drawing(kind: type[Value]) -> Callable[[DrawingOf], DrawingOf]:
    """Register the function that draws the values of a type (decorator)."""
    return _register_in(_DRAWINGS, kind)


def drawing_of(value: Value) -> Drawing:
    """Return what is drawn of a value; nothing where no plugin draws it."""
    if type(value) not in _DRAWINGS:
        load_plugins()
    return _DRAWINGS[type(value)](value) if type(value) in _DRAWINGS else Drawing()


def register_covariance(cause: str) -> Callable[[CovariancePart], CovariancePart]:
    """Register the function that gives the part (6, 6) of a pose's covariance that is due to `cause` (decorator)."""
    return _register_in(_COVARIANCES, cause)


def covariance_due_to(cause: str, pose: Pose) -> F64:
    """Return the part (6, 6) of a pose's covariance that is due to `cause`; zero where no plugin knows of it."""
    if cause not in _COVARIANCES:
        load_plugins()
    return _COVARIANCES[cause](pose) if cause in _COVARIANCES else np.zeros((6, 6))


def plugins_of(slot: str) -> dict[str, type[Any]]:
    """Return name -> class of a slot's registered plugins, sorted by name; of all of them after `load_plugins`."""
    return dict(sorted(_PLUGINS[slot].items()))


def name_of(slot: str, plugin: Any) -> str:
    """Return the name under which the class of a plugin is registered; that of the class where it is not."""
    return next((name for name, kind in _PLUGINS[slot].items() if kind is type(plugin)), type(plugin).__name__)


def options_of(plugin: type[Any]) -> list[dataclasses.Field[Any]]:
    """Return the configuration fields of a plugin."""
    return list(dataclasses.fields(plugin))


@functools.cache
def _load_built_in() -> None:
    for package in _BUILT_IN:
        root = importlib.import_module(package)
        for module in pkgutil.walk_packages(root.__path__, package + "."):
            try:
                importlib.import_module(module.name)
            except ModuleNotFoundError as error:
                library = str(error.name).partition(".")[0]
                if library == "trihedron":
                    raise
                _BROKEN[f"what needs {library}"] = str(library_error(library, error))


def load_plugins() -> None:
    """Import every built-in plugin, and those of packages (`load_packages`). A module whose library is not installed is left out."""
    with _LOADING:
        _load_built_in()
        load_packages()


def load_packages() -> None:
    """Import each module of the entry-point group `trihedron.plugins`, and the names of earlier versions. A package that does not load is reported
    once, on standard error, and left out; its plugins are unknown names."""
    with _LOADING:
        importlib.import_module("trihedron.plugins.renamed")
        for entry in entry_points(group=ENTRY_POINT_GROUP):
            package = f"{entry.dist.name if entry.dist else entry.name} ({entry.value})"
            if package in _BROKEN:
                continue
            try:
                entry.load()
            except (Exception, SystemExit) as error:
                cause = str(error) if isinstance(error, TrihedronError) else f"{type(error).__name__}: {error}"
                _BROKEN[package] = printable(cause)
                line = f"plugin package {package}: does not load: {_BROKEN[package]}; it is left out until you mend or uninstall it"
                print(f"trihedron: warning: {line}", file=sys.stderr)


def broken_packages() -> dict[str, str]:
    """Return each package of plugins, with its module, that does not load, and what needs a library that is not installed, and why; call
    `load_plugins` first."""
    return dict(_BROKEN)
