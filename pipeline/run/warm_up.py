"""Warm-up: the first frames are run once before the clock starts, so that no frame waits for what is compiled, loaded or allocated once."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Any

from numba.core import event
from tqdm import tqdm

from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.machine_code import carried, why_unused
from trihedron.pipeline.run.budget import Budget
from trihedron.pipeline.run.memory import malloc_trim
from trihedron.pipeline.run.runner import Runner

EVENTS: Any = event  # documented in numba's Event API, without types
WARM_UP_FRAMES = 3  # enough for every stage to have been called
COMPILING = "compiling functions {}, for this machine, once"
NEW = "called for the first time"  # what no compilation beforehand comes to: a plugin's own, types of arguments that only some data has
PLAIN_SECONDS = 10.0  # between two lines where standard error is no terminal


def shows_bars() -> bool:
    """Return True where standard error is a terminal or the output of a notebook's cell, which show progress bars."""
    return sys.stderr.isatty() or "ipykernel.iostream" in sys.modules


class Progress:
    """Progress of compilation on standard error: a bar on a terminal, else a line every few seconds. Nothing is printed before the first function."""

    def __init__(self, what: str = NEW, total: int | None = None) -> None:
        """`what` names the functions that are compiled, `total` is how many, about."""
        self.count, self._total, self._message = 0, total, COMPILING.format(what)
        self._bar: tqdm[None] | None = None
        self._began = self._printed = 0.0

    def update(self) -> None:
        """Count one compiled function."""
        self.count += 1
        now = time.perf_counter()
        if self.count == 1:
            because = f" ({why_unused()})" if carried() and why_unused() else ""
            print(f"{self._message}{because} ...", file=sys.stderr, flush=True)
            self._began = self._printed = now
            self._bar = tqdm(total=self._total, unit="function", leave=False) if shows_bars() else None
        if self._bar is not None:
            self._bar.total = None if self._total is None else max(self._total, self.count)
            self._bar.update()
        elif now - self._printed > PLAIN_SECONDS:
            self._printed = now
            of = "" if self._total is None else f" of about {max(self._total, self.count)}"
            print(f"{self._message}: {self.count}{of} after {now - self._began:.0f} s", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.close()


class _Compiled(event.Listener):
    """Calls a function as each compilation ends; numba broadcasts none for what a cache has."""

    def __init__(self, update: Callable[[], None]) -> None:
        self._update = update

    def on_start(self, event: event.Event) -> None:
        """Nothing: a function is counted when it is done."""

    def on_end(self, event: event.Event) -> None:
        """Count it."""
        self._update()


class CompilerClock(event.Listener):
    """CPU seconds that numba's compiler has taken so far in each thread, within the context."""

    def __init__(self) -> None:
        self._own = threading.local()

    def __enter__(self) -> CompilerClock:
        EVENTS.register("numba:compile", self)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        EVENTS.unregister("numba:compile", self)

    def seconds(self) -> float:
        """Return those of the thread that asks."""
        return float(getattr(self._own, "seconds", 0.0))

    def on_start(self, event: event.Event) -> None:
        """A function, or one that it calls: those are compiled within it."""
        self._own.depth = getattr(self._own, "depth", 0) + 1
        if self._own.depth == 1:
            self._own.began = time.thread_time()

    def on_end(self, event: event.Event) -> None:
        """The outermost counts."""
        self._own.depth -= 1
        if self._own.depth == 0:
            self._own.seconds = self.seconds() + time.thread_time() - self._own.began


class compilations:
    """Context within which `update` is called once for each function that numba compiles in this process."""

    def __init__(self, update: Callable[[], None]) -> None:
        self._listener = _Compiled(update)

    def __enter__(self) -> None:
        EVENTS.register("numba:compile", self._listener)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        EVENTS.unregister("numba:compile", self._listener)


@contextmanager
def compilation_reported() -> Iterator[None]:
    """Within this a message appears on standard error when the first function is compiled, and the count while more are."""
    progress = Progress()
    try:
        with compilations(progress.update):
            yield
    finally:
        progress.close()


_WARM: set[str] = set()  # stages with their options, and data sets, that this process has warmed up


def warm_up(runner: Runner) -> None:
    """Call every stage on the first frames and discard the results, unless this process has done so for all of them; an error here is left to the
    run itself, which reports it."""
    called = {name: runner.graph.stages[name] for name in runner.computed}
    called |= {name: runner.budgeted.stage(stage, 0) for name, stage in called.items()} if runner.budgeted is not None else {}
    plugins = {name: stage.plugin for name, stage in called.items()}
    stages = {f"{name}={type(plugin) if name == 'dataset' else plugin!r}" for name, plugin in plugins.items()}
    if stages <= _WARM:
        return
    runner.count = min(runner.count, WARM_UP_FRAMES)
    with suppress(TrihedronError):
        for _ in runner.steps(None, frozenset()):
            pass
        _WARM.update(stages)
    malloc_trim()  # the data set's and the compiler's memory: frames would grow into it, unseen in the memory that the run reports


def warm_up_budgeted(trial: Callable[..., Runner], budget: Budget | None) -> None:
    """Warm up the runner that `trial` makes, and those in which one word of the budget holds, two, and so on (`trial(budget=...)`)."""
    warm_up(trial())
    for changed in budget.each() if budget is not None else ():
        warm_up(trial(budget=changed))
