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

from trihedron.pipeline.cli import main as command
from trihedron.pipeline.errors import TrihedronError
from trihedron.tools.arguments import Parser

TYPICAL = ("dataset.width=160", "dataset.height=120", "dataset.length=40", "outputs=[trajectory,surface]")


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises TrihedronError where a process is ended from outside."""
    parser = Parser("compile", __name__)
    parser.add_argument("--list", action="store_true", help="print what a short run, and one of the given words, compile, for pipeline/kernels.json")
    parser.add_argument("overrides", nargs="*", help="with --list: words of a run, as dataset=tum dataset.path=FOLDER")
    options = parser.parse_args(argv)
    if options.list:
        print(compiled_by_runs(options.overrides))
        return 0
    from trihedron.pipeline.kernels import compile_rows, cores, missing

    began, rows = time.perf_counter(), missing()
    finished = max(compile_rows(rows, cores()), default=0) if rows else 0
    if finished < len(rows):
        raise TrihedronError("compile", f"{len(rows) - finished} of {len(rows)} kernels were not compiled", "see that 1.2 GB of memory are free")
    print(f"ready after {time.perf_counter() - began:.0f} s on {cores()} cores")
    return 0


def compiled_by_runs(overrides: list[str]) -> str:
    """JSON, a kernel a line, of what these runs find in no cache."""
    from trihedron.pipeline import kernels

    kernels.alone = True
    misses = kernels.Misses()
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr), kernels.watched(misses):
        for number, words in enumerate([TYPICAL, overrides][: 2 if overrides else 1]):
            command(["run", *words, f"out={folder}/{number}"])
    return "[\n" + ",\n".join(json.dumps(kernel) for kernel in kernels.listed(misses)) + "\n]"
