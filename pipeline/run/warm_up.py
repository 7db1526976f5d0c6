"""What a run computes with is compiled and loaded before it is asked for."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.run.kernels import FEW, Awaited, Compilation, missing, used_by
from trihedron.pipeline.run.memory import gc_paused, malloc_trim
from trihedron.pipeline.run.runner import Runner

WARM_UP_FRAMES = 3  # enough for every stage to have been called
SILENT_SECONDS = 5.0  # before it is said why no frame is seen yet; with compiled kernels the first frames take less


@contextmanager
def prepared(runner: Runner, trial: Callable[[], Runner]) -> Iterator[Callable[[], float]]:
    """Within this a run finds its kernels; gives what tells for how many seconds calls have waited for them.

    Where a cache has them, the first frames of `trial`, a runner as this one, are run and thrown away: no frame waits for what is loaded or allocated
    once. Else other processes compile beside the run, and a call waits for what is not there yet, which is once an installation. What is
    fed in real time does not begin before all is there."""
    with gc_paused():
        rows = missing(used_by(runner.graph.stages[name].plugin for name in runner.computed))
    if len(rows) <= FEW:
        _warm_up(trial())
        yield lambda: 0.0
        return
    print(f"compiling {len(rows)} functions for this machine, once ...", file=sys.stderr, flush=True)
    with Compilation(rows) as compilation, Awaited(rows) as awaited, _bar(len(rows)) as bar:
        follower = threading.Thread(target=_follow, args=(compilation, awaited, bar), daemon=True)
        follower.start()
        try:
            if runner.feed is not None:
                follower.join()
                _warm_up(trial())
            yield lambda: awaited.seconds
        finally:
            compilation.give_up()
            follower.join()


def _bar(total: int) -> tqdm[None]:
    return tqdm(total=total, disable=not sys.stderr.isatty(), leave=False, unit="function")


def _follow(compilation: Compilation, awaited: Awaited, bar: tqdm[None]) -> None:
    """Let calls go on as rows are done, and when no more will be."""
    for row in compilation:
        awaited.done(row)
        bar.update()
    awaited.end()


def _warm_up(runner: Runner) -> None:
    """Call every stage on the first frames; what goes wrong here is reported by the run itself."""
    runner.count = min(runner.count, WARM_UP_FRAMES)
    why = "preparing: what else computes is compiled for this machine, once, then loaded"
    said = threading.Timer(SILENT_SECONDS, print, [why], {"file": sys.stderr, "flush": True})
    said.daemon = True
    said.start()
    try:
        for _ in runner.steps(None, frozenset()):
            pass
    except TrihedronError:
        pass
    finally:
        said.cancel()
    malloc_trim()  # what the data set and the kernels needed to begin with: else the frames grow into it, unseen in what the run says it holds
