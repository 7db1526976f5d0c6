"""Compile ahead of the first run what the default graph computes with: as a step of making a container, or before a robot drives off.

Without it the first run does so itself. Compiled functions are cached in the user's cache folder (`~/.cache/trihedron/kernels`; NUMBA_CACHE_DIR names
another), for this processor and these versions.

Example: trihedron compile
"""

from __future__ import annotations

from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises TrihedronError where a process fails."""
    Parser("compile", __name__).parse_args(argv)
    from trihedron.pipeline.app.compilation import compile_kernels

    print(f"ready after {compile_kernels():.0f} s")
    return 0
