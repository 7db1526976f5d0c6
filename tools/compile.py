"""Compile ahead of the first run what the default graph computes with, on all cores: as a step of making a container, or before a robot drives off.

Without it the first run does so itself. Compiled kernels are kept beside the sources, or where those cannot be written to, in the user's cache folder
(NUMBA_CACHE_DIR names another); they are for this processor and these versions.

Example: trihedron compile
"""

from __future__ import annotations

import json
import os
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
    parser.add_argument("--list", action="store_true", help="print what a short run still has to compile, in the form of pipeline/kernels.json")
    if parser.parse_args(argv).list:
        print(compiled_by_a_run())
        return 0
    from trihedron.pipeline.kernels import begin_shares, cores

    began, count = time.perf_counter(), cores()
    codes = [process.wait() for process in begin_shares(count)]
    if any(codes):
        raise TrihedronError("compile", f"{sum(map(bool, codes))} of {count} processes were ended", "see that there is memory, 250 MB a process")
    print(f"ready after {time.perf_counter() - began:.0f} s on {count} cores")
    return 0


def compiled_by_a_run() -> str:
    """JSON, a kernel a line."""
    from trihedron.pipeline.kernels import Misses, listed, watched

    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])  # so that no other process compiles beside
    misses = Misses()
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr), watched(misses):
        command(["run", *TYPICAL, f"out={folder}/run"])
    return "[\n" + ",\n".join(json.dumps(kernel) for kernel in listed(misses.kernels)) + "\n]"
