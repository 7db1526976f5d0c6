"""Compile the kernels of the default graph in two processes, before the first run or when `trihedron compile` is called.

numba compiles one function at a time in a process, and knows the types of the arguments only from a call. So two processes run the graph on small
images of the built-in room: one as far as the Manhattan frame, then to bundle adjustment, of poses that are not refined; the other with points alone
to refined poses, then with all stages. What both need is compiled by the one that comes to it first, and loaded from the cache by the other. Both
take about as long, and neither comes to a part while the other compiles it. A third process would, so that more cores compile no faster
(decision 337).
"""

from __future__ import annotations

import gc
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stderr, redirect_stdout, suppress
from importlib.metadata import version
from pathlib import Path

from llvmlite import binding

from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.kernel import cache_folder
from trihedron.pipeline.core.machine_code import BASELINE, archive, pack
from trihedron.pipeline.run.warm_up import Progress, compilations

SMALL = ("width=160", "height=120")
WHOLE = tuple(f"dataset.{word}" for word in SMALL)  # all frames of the room: some functions are called now and then
ROOM = (*WHOLE, "dataset.length=40")
LOST = ("dataset=faults", *(f"+dataset.options.{word}" for word in SMALL), "dataset.cover=10:20")
DIRECTIONS = (*ROOM, "dataset.frames=0:5", "outputs=[manhattan]")
POINTS = (
    *ROOM, "normals=none", "planes=none", "lines=none", "bundle=none", "rotation=constant_velocity",
    "graph.tracks.manhattan=null", "graph.tracks.previous_manhattan=null",
)  # fmt: skip
UNREFINED = (*ROOM, "pose=none")
SURFACE = (*ROOM, "outputs=[trajectory,surface]")
FOUND, UNKNOWN = (*LOST, "dataset.frames=0:100"), (*LOST, "dataset.frames=0:60", "+dataset.options.texture=false")
TRACKING = ((DIRECTIONS, UNREFINED), (POINTS, WHOLE))  # runs of each process before a run, which compiles what is left as it comes to it
TURN = (*WHOLE, "dataset.length=300", "dataset.motion=pan")  # round which a loop is closed
ALL = (
    (DIRECTIONS, UNREFINED, SURFACE),
    (POINTS, WHOLE, FOUND, UNKNOWN, TURN),
)  # and before a live run: also what a surface, a loss, the way back and a loop need
BUILDING, LIVE = (*ROOM, "outputs=[trajectory,building]"), (*ROOM, "live=true")
AGAIN = ("replay={folder}/1/run.mcap", "only=[surface]", "outputs=[trajectory,surface]")  # of the second run of a process
RECORDED = ("dataset.length=4", "record.frames=true")  # in the size of a Kinect's images
KINECT = ("dataset=mcap", f"dataset.path={{folder}}/{len(ALL[0])}/run.mcap", "dataset.camera=seven_scenes")
WHEEL = (
    (*ALL[0], RECORDED, KINECT),
    (POINTS, ROOM, AGAIN, BUILDING, LIVE, *ALL[1][1:]),
)  # and for a wheel: also buildings, replays, images of a Kinect
PARTS = {"tracking": TRACKING, "all": ALL, "wheel": WHEEL}
LATER = "surfaces, loops, a loss and relocalisation"
# What the line about compiling names, and how many functions both processes compile, about; numba's own are compiled by each
SHOWN = {
    "tracking": ("of tracking", 675),
    "all": (f"of tracking, {LATER}", 815),
    "later": (f"of {LATER}", 210),  # what `all` compiles after `tracking`
    "wheel": ("of all that a wheel brings", 885),
}
SHORT = 150  # frames of a run that hardly closes a loop
STAGES = {"keypoints", "lines", "planes", "manhattan"}  # of the graphs that these runs compile most of
SWITCH = "TRIHEDRON_COMPILE"  # environment variable: with 0 a run compiles what it calls and nothing beforehand
_ONCE = threading.Lock()  # runs that begin in several threads at once compile once
GARBAGE = 100_000  # new objects between two collections: nearly all that the compiler makes is short-lived


def compile_kernels(what: str = "all") -> float:
    """Compile the default graph's kernels, `tracking` or `all` of them, with progress on standard error; returns seconds.

    Raises TrihedronError where a process fails."""
    shown = "later" if what == "all" and marker("tracking").exists() else what
    seconds = _compile(what, Progress(*SHOWN[shown]))
    marker(what).parent.mkdir(parents=True, exist_ok=True)
    marker(what).touch()
    return seconds


def _compile(what: str, progress: Progress, **variables: str) -> float:
    """Compile a part of PARTS in processes with these further environment variables; returns seconds. Raises TrihedronError."""
    began = time.perf_counter()
    command = [sys.executable, "-m", __name__]
    environment = {**os.environ, SWITCH: "0", **variables}
    workers = [subprocess.Popen([*command, what, str(part)], stdout=subprocess.PIPE, env=environment) for part in range(len(PARTS[what]))]
    lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threads = [threading.Thread(target=_forward, args=(worker, lines), daemon=True) for worker in workers]
    for thread in threads:
        thread.start()
    try:
        ended = 0
        while ended < len(workers):
            line = lines.get()
            ended += not line
            if line:
                progress.update()
    finally:
        for worker in workers:
            worker.terminate()
            worker.wait()
        progress.close()
    if any(worker.returncode for worker in workers):
        raise TrihedronError("compile", "not all functions were compiled", "see that 2 GB of memory are free, then repeat: trihedron compile --debug")
    return time.perf_counter() - began


def compile_once(stages: Sequence[str], frames: int | None) -> None:
    """Fill the cache before a run of these stages, unless that was done for these versions and this processor, or a wheel brought the machine code.
    For a run of more than SHORT `frames`, or a live one (None), with all that it may come to need: no frame waits for the compiler when a loop is
    closed. A graph that lacks some of STAGES compiles what it calls as it runs, unless it is live: a camera does not wait. So does any run where the
    variable TRIHEDRON_COMPILE is 0."""
    what, has = ("all" if frames is None or frames > SHORT else "tracking"), STAGES & set(stages)
    if archive() is not None:
        return
    with _ONCE:
        if os.environ.get(SWITCH) != "0" and (has == STAGES or (has and frames is None)) and not (marker(what).exists() or marker("all").exists()):
            with suppress(TrihedronError, OSError):  # the run compiles by itself
                compile_kernels(what)


def compile_for_wheel(out: Path) -> float:
    """Compile what a wheel carries, for the baseline of `core.machine_code`, and write its archive; returns seconds. Raises TrihedronError."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = _compile("wheel", Progress(*SHOWN["wheel"]), NUMBA_CPU_NAME=BASELINE, NUMBA_CPU_FEATURES="", NUMBA_CACHE_DIR=folder)
        pack(Path(folder) / cache_folder().name, out)
    return seconds


def marker(what: str) -> Path:
    """File that is there once `compile_kernels` has filled the cache for these versions and this processor."""
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    return cache_folder() / f"{what}-{version('trihedron')}-{python}-{binding.get_host_cpu_name()}"


def _forward(worker: subprocess.Popen[bytes], lines: queue.SimpleQueue[bytes]) -> None:
    """Pass on a worker's lines, an empty one at its end."""
    assert worker.stdout is not None
    for line in worker.stdout:
        lines.put(line)
    worker.wait()
    lines.put(b"")


def _work(what: str, part: int) -> int:
    """Make the runs of one part, writing a line to standard output for each function that is compiled; returns the exit code."""
    from trihedron.pipeline.app.cli import main as command

    gc.freeze()
    gc.set_threshold(GARBAGE, 10, 10)
    out, failures = sys.stdout, 0
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        nowhere = stack.enter_context(open(os.devnull, "w"))
        stack.enter_context(redirect_stdout(nowhere))
        stack.enter_context(redirect_stderr(nowhere))
        stack.enter_context(compilations(lambda: print(file=out, flush=True)))
        for number, words in enumerate(PARTS[what][part]):
            given = [word.format(folder=folder) for word in words]
            failures += command(["run", *given, "threads=1", f"out={folder}/{number}"]) != 0
    return min(failures, 1)


if __name__ == "__main__":
    sys.exit(_work(sys.argv[1], int(sys.argv[2])))
