"""Compile ahead of the first run what the default graph computes with, on all cores: as a step of making a container, or before a robot drives off.

Without it the first run does so itself. Compiled kernels are kept beside the sources, or where those cannot be written to, in the user's cache folder
(NUMBA_CACHE_DIR names another); they are for this processor and these versions.

Example: trihedron compile
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from contextlib import redirect_stdout

from trihedron.pipeline.app.cli import main as command
from trihedron.pipeline.core.errors import TrihedronError
from trihedron.tools.arguments import Parser

SMALL = ("width=160", "height=120")
LOST = ("dataset=faults", *(f"+dataset.options.{word}" for word in SMALL), "dataset.cover=10:20")
RUNS = (  # a room and its surface; lost and found again by points; lost where there are hardly any
    (*(f"dataset.{word}" for word in SMALL), "dataset.length=40", "outputs=[trajectory,surface]"),
    (*LOST, "dataset.frames=0:100"),
    (*LOST, "dataset.frames=0:60", "+dataset.options.texture=false"),
)
FIRST = ("dataset.frames=0:1", "outputs=[trajectory]")
IN_TURN = "threads=1"


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises TrihedronError where a process is ended from outside."""
    parser = Parser("compile", __name__)
    parser.add_argument("--list", action="store_true", help="print what short runs, and one of the given words, call, for pipeline/kernels.json")
    parser.add_argument("overrides", nargs="*", help="with --list: words of a run, as dataset=tum dataset.path=FOLDER")
    options = parser.parse_args(argv)
    if options.list:
        print(compiled_by_runs(options.overrides))
        return 0
    from trihedron.pipeline.run.kernels import Compilation, cores, missing

    began, rows = time.perf_counter(), missing()
    with Compilation(rows) as compilation:
        finished = sum(1 for _ in compilation)
    if finished < len(rows):
        raise TrihedronError("compile", f"{len(rows) - finished} of {len(rows)} kernels were not compiled", "see that 1.2 GB of memory are free")
    print(f"ready after {time.perf_counter() - began:.0f} s on {cores()} cores")
    return 0


def compiled_by_runs(overrides: list[str]) -> str:
    """JSON, a kernel a line, of what these runs call: first what their first frames need, and what takes longest, which only an empty cache tells."""
    from trihedron.pipeline.run import kernels

    kernels.alone = True
    runs = [*RUNS, *([tuple(overrides)] if overrides else [])]
    found: dict[str, None] = {}  # in the order they were met
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr):
        for number, words in enumerate([*((*run, *FIRST) for run in runs), *runs]):
            with kernels.Called() as called:
                command(["run", *words, IN_TURN, f"out={folder}/{number}"])
            found |= {json.dumps(kernel): None for kernel in kernels.listed(called) if json.dumps(kernel) not in found}
    return "[\n" + ",\n".join(found) + "\n]"
