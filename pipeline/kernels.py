"""Compiles kernels on all cores where none is cached yet.

numba compiles a kernel when it is first called, and one at a time whatever the number of threads: some hundred seconds for the default graph. What
that graph calls is listed in `kernels.json`, the longest to compile first (`trihedron compile --list` writes it). Before a run calls anything, other
processes compile what it may call and no cache has; each takes the next row of that list as soon as it is done with one.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
from numba.core import event

types: Any = numba.types  # which says little of its classes
Kind = Any  # one of those types
LISTED = Path(__file__).with_name("kernels.json")
FEW = 3  # kernels, which the run compiles itself as it comes to them
MOST = 8  # processes; one alone comes to 1.1 GB, several divide what is to be compiled
ROW = 2  # bytes of a row's number
ARRAY = re.compile(r"(readonly )?(\w+)(?:\[(\d+)([CFA])\])?")


class Misses(event.Listener):
    """Which kernels were compiled since for calls by the interpreter: (module:name, types of the arguments), and how long it took."""

    def __init__(self) -> None:
        self.kernels: list[tuple[str, tuple[Kind, ...]]] = []
        self.seconds: list[float] = []
        self._began: list[float] = []  # of what is being compiled, each for the one before

    def on_start(self, compiled: event.Event) -> None:
        self._began.append(time.perf_counter())

    def on_end(self, compiled: event.Event) -> None:
        began = self._began.pop()
        if not self._began:
            function = compiled.data["dispatcher"].py_func
            self.kernels.append((f"{function.__module__}:{function.__qualname__}", compiled.data["args"]))
            self.seconds.append(time.perf_counter() - began)


def watched(listener: event.Listener) -> AbstractContextManager[None]:
    """While the listener is told of each kernel that is compiled."""
    install: Any = event.install_listener
    context: AbstractContextManager[None] = install("numba:compile", listener)  # none begins for what a cache has
    return context


alone = False  # whether a run compiles by itself whatever it calls


class _Missing(Exception):
    """No cache has the kernel."""


class _Refusal(event.Listener):
    """Ends each compilation before it begins."""

    def on_start(self, compiled: event.Event) -> None:
        raise _Missing

    def on_end(self, compiled: event.Event) -> None:
        """None has begun."""


def missing(modules: Collection[str] | None = None) -> list[int]:
    """Rows of the list, or of those modules alone, that no cache has. What a cache has is loaded, and need not be again."""
    rows: list[int] = []
    if alone:
        return rows
    with watched(_Refusal()):
        for row, (kernel, arguments) in enumerate(json.loads(LISTED.read_text())):
            if modules is None or kernel.partition(":")[0] in modules:
                try:
                    dispatcher, kinds = kernel_of(kernel, arguments)
                    dispatcher.compile(kinds)
                except _Missing:
                    rows.append(row)
                except Exception:  # it is not as listed, which costs the run time and nothing else
                    continue
    return rows


def kernel_of(kernel: str, arguments: list[Any]) -> tuple[Any, tuple[Kind, ...]]:
    """What numba made of a listed function, and the types to compile it for; any exception where these are not as listed."""
    module, name = kernel.split(":")
    return getattr(importlib.import_module(module), name), tuple(type_of(argument) for argument in arguments)


def used_by(objects: Iterable[Any]) -> set[str]:
    """The project's modules that these objects' modules take something from, and so on."""
    found = {"trihedron.pipeline.gathering", "trihedron.pipeline.row_kernels"}  # which tables and recordings import when they first need them
    pending = {type(item).__module__ for item in objects}
    while pending:
        found |= pending
        content = [value for name in pending & sys.modules.keys() for value in vars(sys.modules[name]).values()]
        owners = {value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None) for value in content}
        pending = {owner for owner in owners if isinstance(owner, str) and owner.startswith("trihedron.")} - found
    return found


def cores() -> int:
    """How many processes can compile at once on this machine."""
    return min(MOST, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def compile_rows(rows: list[int], count: int) -> Iterator[int]:
    """Compile these rows in `count` processes, yielding how many are done whenever it is one more; to close it ends them."""
    program = [sys.executable, "-m", "trihedron.pipeline.kernel_compiler"]
    taken, given = os.pipe()
    os.write(given, b"".join(row.to_bytes(ROW, "little") for row in rows))
    os.close(given)
    done, said = os.pipe()
    plain = os.environ | {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}  # of errors that nobody sees, and which are many
    processes = [subprocess.Popen(program, stdin=taken, stdout=said, stderr=subprocess.DEVNULL, env=plain) for _ in range(count)]
    os.close(taken)
    os.close(said)
    finished = 0
    try:
        while some := os.read(done, len(rows)):
            finished += len(some)
            yield finished
    finally:
        os.close(done)
        for process in processes:
            process.terminate()
            process.wait()


def listed(misses: Misses) -> list[list[Any]]:
    """What `kernels.json` holds of kernels: [module:name, [argument, ...]]; those of the project whose arguments have a word, the longest first."""
    found = []
    for (kernel, arguments), _ in sorted(zip(misses.kernels, misses.seconds, strict=True), key=lambda one: -one[1]):
        if kernel.startswith("trihedron."):
            try:
                found.append([kernel, [word_of(argument) for argument in arguments]])
            except TypeError:
                continue
    return found


def word_of(kind: Kind) -> Any:
    """A type as JSON: 'float64', 'readonly float32[2C]', [items of a tuple], {module:class of a named tuple: [items]}, or of an array of records
    {'[2C]': [[field, its NumPy type], ...]}; TypeError for any other."""
    if isinstance(kind, types.Array) and kind.aligned and isinstance(kind.dtype, types.Number | types.Boolean):
        return f"{'' if kind.mutable else 'readonly '}{kind.dtype}[{kind.ndim}{kind.layout}]"
    if isinstance(kind, types.Array) and isinstance(kind.dtype, types.Record) and kind.mutable:
        return {f"[{kind.ndim}{kind.layout}]": [list(field) for field in numba.np.numpy_support.as_dtype(kind.dtype).descr]}
    if isinstance(kind, (types.NamedTuple, types.NamedUniTuple)):
        named = kind.instance_class
        return {f"{named.__module__}:{named.__qualname__}": [word_of(item) for item in kind]}
    if isinstance(kind, types.BaseTuple):
        return [word_of(item) for item in kind]
    if isinstance(kind, types.Number | types.Boolean):
        return str(kind)
    raise TypeError(f"no word for {kind}")


def type_of(word: Any) -> Kind:
    """The type that `word_of` wrote down."""
    if isinstance(word, list):
        return types.BaseTuple.from_types([type_of(item) for item in word])
    if isinstance(word, dict):
        ((path, items),) = word.items()
        if path.startswith("["):
            record = numba.from_dtype(np.dtype([tuple(field) for field in items]))
            return types.Array(record, int(path[1]), path[2], aligned=False)
        module, name = path.split(":")
        return types.BaseTuple.from_types([type_of(item) for item in items], getattr(importlib.import_module(module), name))
    match = ARRAY.fullmatch(word)
    assert match is not None, word
    readonly, scalar, dimensions, layout = match.groups()
    kind = getattr(types, "boolean" if scalar == "bool" else scalar)
    return kind if dimensions is None else types.Array(kind, int(dimensions), layout, readonly=readonly is not None)
