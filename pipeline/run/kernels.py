"""Compiles kernels on all cores where none is cached yet.

numba compiles a kernel when it is first called, and one at a time whatever the number of threads: some hundred seconds for the default graph. What
that graph calls is listed in `kernels.json`, what the first frame needs before the rest, of both the longest to compile first (`trihedron compile
--list` writes it). Other processes compile what a run may call and no cache has; each takes the next row of that list as soon as it is done with one.
Meanwhile the run begins, and waits for a kernel where it calls one that is not there yet: the first frames are done while the rest is compiled.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numba
import numpy as np
from numba.core import event
from numba.core.dispatcher import Dispatcher, OmittedArg

from trihedron.pipeline.run.interrupts import Interrupts

types: Any = numba.types  # which says little of its classes
DISPATCHER: Any = Dispatcher
Kind = Any  # one of those types
Kin = TypeVar("Kin", bound="_FirstCalls")
LISTED = Path(__file__).with_name("kernels.json")
FEW = 3  # kernels, which the run compiles itself as it comes to them
MOST = 8  # processes; one alone comes to 1.1 GB, several divide what is to be compiled
ROW = 2  # bytes of a row's number
LOOK_S = 0.2  # between two looks of a call that waits, whether a Ctrl-C came
ARRAY = re.compile(r"(readonly )?(\w+)(?:\[(\d+)([CFA])\])?")


class _FirstCalls(ABC):
    """While this is entered, `_called` takes the place of what numba does when the interpreter calls a kernel with types it has not met."""

    def __init__(self) -> None:
        self._compile = DISPATCHER._compile_for_args

    def __enter__(self: Kin) -> Kin:
        DISPATCHER._compile_for_args = lambda dispatcher, *arguments: self._called(dispatcher, *arguments)
        return self

    def __exit__(self, *_: Any) -> None:
        DISPATCHER._compile_for_args = self._compile

    @abstractmethod
    def _called(self, dispatcher: Any, *arguments: Any) -> Any: ...


class Called(_FirstCalls, event.Listener):
    """While this is entered: which kernels the interpreter calls for the first time, (module:name, types of the arguments), and the seconds until
    each can run. What is compiled as a part of one is forgotten by numba, so that a call of its own is seen too."""

    def __init__(self) -> None:
        super().__init__()
        self.kernels: dict[tuple[str, tuple[Kind, ...]], float] = {}
        self._compiled: list[Any] = []

    def on_start(self, compiled: event.Event) -> None:
        self._compiled.append(compiled.data["dispatcher"])

    def on_end(self, compiled: event.Event) -> None:
        """It is in a cache now."""

    def _called(self, dispatcher: Any, *arguments: Any) -> Any:
        began, function = time.perf_counter(), dispatcher.py_func
        with watched(self):
            result = self._compile(dispatcher, *arguments)
        for part in set(self._compiled) - {dispatcher}:
            part._reset_overloads()
        self._compiled.clear()
        self.kernels.setdefault((f"{function.__module__}:{function.__qualname__}", _kinds(dispatcher, arguments)), time.perf_counter() - began)
        return result


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
    found: set[str] = set()
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


class Compilation:
    """Rows of the list that other processes compile. Iterating gives each that is done, and ends when there is nothing more to come; a row that was
    not given failed, and is left to who calls it. At the block's end whatever is not done is given up."""

    def __init__(self, rows: Sequence[int]) -> None:
        program = [sys.executable, "-m", "trihedron.pipeline.run.kernel_compiler"]
        taken, given = os.pipe()
        os.write(given, b"".join(row.to_bytes(ROW, "little") for row in rows))
        os.close(given)
        self._done, said = os.pipe()
        plain = os.environ | {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}  # of errors that nobody sees, and which are many
        count = min(cores(), len(rows))
        self._processes = [subprocess.Popen(program, stdin=taken, stdout=said, stderr=subprocess.DEVNULL, env=plain) for _ in range(count)]
        os.close(taken)
        os.close(said)

    def __iter__(self) -> Iterator[int]:
        while row := os.read(self._done, ROW):
            yield int.from_bytes(row, "little")

    def __enter__(self) -> Compilation:
        return self

    def __exit__(self, *_: Any) -> None:
        self.give_up()
        os.close(self._done)

    def give_up(self) -> None:
        """End the processes; what is iterating comes to its end."""
        for process in self._processes:
            process.terminate()
            process.wait()


class Awaited(_FirstCalls):
    """Kernels that are being compiled elsewhere: while this is entered, a call of one of them waits until it is there."""

    def __init__(self, rows: Sequence[int]) -> None:
        super().__init__()
        listed = json.loads(LISTED.read_text())
        self._pending = {_key(*kernel_of(*listed[row])): row for row in rows}
        self._change = threading.Condition()
        self._waiting, self._began = 0, 0.0
        self.seconds = 0.0  # in which any call waited

    def __exit__(self, *_: Any) -> None:
        self.end()
        super().__exit__()

    def done(self, row: int) -> None:
        """A row need not be waited for any more."""
        with self._change:
            self._pending = {key: other for key, other in self._pending.items() if other != row}
            self._change.notify_all()

    def end(self) -> None:
        """None need be: who waits compiles it."""
        with self._change:
            self._pending = {}
            self._change.notify_all()

    def _called(self, dispatcher: Any, *arguments: Any) -> Any:
        key = _key(dispatcher, _kinds(dispatcher, arguments))
        with self._change:
            if key in self._pending:
                self._wait(key)
        return self._compile(dispatcher, *arguments)

    def _wait(self, key: tuple[Any, ...]) -> None:
        self._began, interrupts = self._began if self._waiting else time.perf_counter(), Interrupts.count
        self._waiting += 1
        while key in self._pending and Interrupts.count == interrupts:
            self._change.wait(LOOK_S)
        self._waiting -= 1
        self.seconds += 0.0 if self._waiting else time.perf_counter() - self._began
        if Interrupts.count > interrupts:
            raise KeyboardInterrupt


def _key(dispatcher: Any, kinds: Iterable[Kind]) -> tuple[Any, ...]:
    return dispatcher.py_func.__module__, dispatcher.py_func.__qualname__, *kinds


def _kinds(dispatcher: Any, arguments: Iterable[Any]) -> tuple[Kind, ...]:
    """The types that numba compiles for when it is called so."""
    return tuple(types.Omitted(item.value) if isinstance(item, OmittedArg) else dispatcher.typeof_pyval(item) for item in arguments)


def listed(called: Called) -> list[list[Any]]:
    """Kernels as `kernels.json` holds them: [module:name, [argument, ...]]; those of the project whose arguments have a word: what the
    recording begins with, then the longest first."""
    found = []
    for (kernel, arguments), _ in sorted(called.kernels.items(), key=lambda one: -one[1]):
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
