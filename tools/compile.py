"""Compile ahead of the first run what the default graph computes with: as a step of making a container, or before a robot drives off.

Without it the first run does so itself. Compiled functions are cached in the user's cache folder (`~/.cache/trihedron/kernels`; NUMBA_CACHE_DIR names
another), for this processor and these versions. A wheel made by `make release` brings them along, for x86-64-v3 and the versions that it was made
with: there is nothing to compile then. --archive FOLDER writes what such a wheel carries into a folder.

Example: trihedron compile
"""

from __future__ import annotations

from pathlib import Path

from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises TrihedronError where a process fails."""
    parser = Parser("compile", __name__)
    parser.add_argument("--archive", type=Path, metavar="FOLDER", help="write the machine code for a wheel here, and cache nothing")
    options = parser.parse(argv)
    from trihedron.pipeline.app.compilation import compile_for_wheel, compile_kernels
    from trihedron.pipeline.core.machine_code import archive, archive_name

    if options.archive:
        options.archive.mkdir(parents=True, exist_ok=True)
        out = options.archive / archive_name()
        seconds = compile_for_wheel(out)
        print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, after {seconds:.0f} s")
    elif archive() is not None:
        print("nothing to compile: this installation carries its machine code")
    else:
        print(f"ready after {compile_kernels():.0f} s")
    return 0
