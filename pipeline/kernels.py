"""Compiles kernels on all cores where none is cached yet.

numba compiles a kernel when it is first called, and one at a time whatever the number of threads: some hundred seconds for the default graph. What
that graph calls is listed in `kernels.json`, in the order of its first calls (`trihedron compile --list` writes it). While a run compiles from the
beginning of that list because it must, other processes do so from its end; what they have done it finds in numba's cache.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from subprocess import DEVNULL
from typing import Any

import numba
from numba.core import event

types: Any = numba.types  # which says little of its classes
Kind = Any  # one of those types
LISTED = Path(__file__).with_name("kernels.json")
COLD = 3  # kernels that no cache has, and nothing is taken to be cached
MOST = 8  # processes; each takes 250 MB
ARRAY = re.compile(r"(readonly )?(\w+)(?:\[(\d+)([CFA])\])?")
PROGRAM = "from trihedron.pipeline.kernels import compile_share; compile_share({}, {})"


class Misses(event.Listener):
    """Which kernels were compiled since, in order of their first call by the interpreter: (module:name, types of the arguments)."""

    def __init__(self) -> None:
        self.kernels: list[tuple[str, tuple[Kind, ...]]] = []
        self._depth = threading.local()

    def on_start(self, compiled: event.Event) -> None:
        self._depth.value = getattr(self._depth, "value", 0) + 1
        if self._depth.value == 1:
            function = compiled.data["dispatcher"].py_func
            self.kernels.append((f"{function.__module__}:{function.__qualname__}", compiled.data["args"]))

    def on_end(self, compiled: event.Event) -> None:
        self._depth.value -= 1


def watched(misses: Misses) -> AbstractContextManager[None]:
    """While `misses` is told of each kernel that is compiled."""
    install: Any = event.install_listener
    context: AbstractContextManager[None] = install("numba:compile", misses)  # none begins for what a cache has
    return context


class _Helpers(Misses):
    """Begins to compile beside at the third kernel that must be compiled."""

    def __init__(self) -> None:
        super().__init__()
        self.processes: list[subprocess.Popen[bytes]] = []

    def on_start(self, compiled: event.Event) -> None:
        super().on_start(compiled)
        if len(self.kernels) == COLD and not self.processes:
            self.processes = begin_shares(cores() - 1)


@contextmanager
def compiled_beside() -> Iterator[None]:
    """Use the other cores where it turns out that kernels must be compiled; whatever is not done at the end is left."""
    helpers = _Helpers()
    try:
        with watched(helpers):
            yield
    finally:
        for process in helpers.processes:
            process.terminate()
            process.wait()


def cores() -> int:
    """How many processes can compile at once on this machine."""
    return min(MOST, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def begin_shares(count: int) -> list[subprocess.Popen[bytes]]:
    """Processes that compile what is listed, each its share."""
    commands = [[sys.executable, "-c", PROGRAM.format(share, count)] for share in range(count)]
    return [subprocess.Popen(command, stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL) for command in commands]


def compile_share(share: int, of: int) -> int:
    """Compile every `of`-th listed kernel, from the last on, that no cache has; how many there were. One that is not as listed is left to the run."""
    mine = json.loads(LISTED.read_text())[::-1][share::of]
    for kernel, arguments in mine:
        module, name = kernel.split(":")
        try:
            getattr(importlib.import_module(module), name).compile(tuple(_type_of(argument) for argument in arguments))
        except Exception:
            continue
    return len(mine)


def listed(kernels: list[tuple[str, tuple[Kind, ...]]]) -> list[list[Any]]:
    """What `kernels.json` holds of kernels: [module:name, [argument, ...]]; those of the project whose arguments have a word."""
    found = []
    for kernel, arguments in kernels:
        if kernel.startswith("trihedron."):
            try:
                found.append([kernel, [_word_of(argument) for argument in arguments]])
            except TypeError:
                continue
    return found


def _word_of(kind: Kind) -> Any:
    """A type as JSON: 'float64', 'readonly float32[2C]', [items of a tuple], {module:class of a named tuple: [items]}; TypeError for any other."""
    if isinstance(kind, types.Array) and kind.aligned and isinstance(kind.dtype, types.Number | types.Boolean):
        return f"{'' if kind.mutable else 'readonly '}{kind.dtype}[{kind.ndim}{kind.layout}]"
    if isinstance(kind, (types.NamedTuple, types.NamedUniTuple)):
        named = kind.instance_class
        return {f"{named.__module__}:{named.__qualname__}": [_word_of(item) for item in kind]}
    if isinstance(kind, types.BaseTuple):
        return [_word_of(item) for item in kind]
    if isinstance(kind, types.Number | types.Boolean):
        return str(kind)
    raise TypeError(f"no word for {kind}")


def _type_of(word: Any) -> Kind:
    """The type that `_word_of` wrote down."""
    if isinstance(word, list):
        return types.BaseTuple.from_types([_type_of(item) for item in word])
    if isinstance(word, dict):
        ((path, items),) = word.items()
        module, name = path.split(":")
        return types.BaseTuple.from_types([_type_of(item) for item in items], getattr(importlib.import_module(module), name))
    match = ARRAY.fullmatch(word)
    assert match is not None, word
    readonly, scalar, dimensions, layout = match.groups()
    kind = getattr(types, "boolean" if scalar == "bool" else scalar)
    return kind if dimensions is None else types.Array(kind, int(dimensions), layout, readonly=readonly is not None)
