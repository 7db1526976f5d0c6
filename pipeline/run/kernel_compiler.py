"""The program of a process that compiles kernels for numba's cache and does nothing else; it is told which on its input, see `kernels.py`.

Whatever a kernel calls numba optimises, translates and keeps for itself, and then once more as a part of the kernel. Here what is called is linked
into its caller and no more, since nobody calls it here; that saves two fifths. A function that Python calls as well is listed, and gets its turn.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
from functools import cache
from typing import Any

from numba import _dynfunc  # type: ignore[attr-defined]  # compiled, without types
from numba.core import caching, codegen, cpu, targetconfig

from trihedron.pipeline.run import compiler_shortcuts
from trihedron.pipeline.run.kernels import LISTED, ROW, kernel_of

GARBAGE = 100_000  # new objects between two looks for what is not used any more; of those of a compilation nearly all are
LIBRARY: Any = codegen.JITCodeLibrary
CONTEXT: Any = cpu.CPUContext
CACHE: Any = caching.CompileResultCacheImpl
OPTIONS: Any = targetconfig.TargetConfig


class LinkedParts:
    """numba's steps for the library of one kernel, and those in their place for the libraries of what it calls."""

    def __init__(self) -> None:
        self.name = ("", "")  # of the kernel: module and qualified name
        self.library: Any = None  # of the kernel
        self._finalize = LIBRARY.finalize
        self._executable, self._cachable = CONTEXT.get_executable, CACHE.check_cachable
        self._wrappers = CONTEXT.create_cpython_wrapper, CONTEXT.create_cfunc_wrapper

    def install(self) -> None:
        """From now on numba takes these steps, in this process."""
        LIBRARY.finalize = lambda library: self.finalize(library)
        CONTEXT.get_executable = lambda context, *of: self.executable(context, *of)
        CONTEXT.create_cpython_wrapper = lambda *of, **how: self.wrap(self._wrappers[0], *of, **how)
        CONTEXT.create_cfunc_wrapper = lambda *of, **how: self.wrap(self._wrappers[1], *of, **how)
        CACHE.check_cachable = lambda cache, result: not is_part(result) and self._cachable(cache, result)
        OPTIONS.values = lambda options: _defaults(options.__class__) | options._values  # asked for at each call that is compiled

    def compile(self, dispatcher: Any, arguments: tuple[Any, ...]) -> None:
        """Compile a kernel unless a cache has it, whole even where it has been part of another."""
        if arguments in dispatcher.overloads and is_part(dispatcher.overloads[arguments]):
            del dispatcher.overloads[arguments]
        self.name = dispatcher.__module__, dispatcher.py_func.__qualname__
        dispatcher.compile(arguments)

    def finalize(self, library: Any) -> None:
        """Link everything that is called to the kernel's library, which is then optimised and translated; parts wait until then."""
        if library is self.library:
            library._linking_libraries = list(_called(library, {}))[::-1]  # of what none has called yet, none is linked
            self._finalize(library)
        else:
            library.is_part = library._finalized = True

    def executable(self, context: Any, library: Any, function: Any, environment: Any) -> Any:
        """What Python would call; of a part it is never called, and leads nowhere."""
        if self.is_kernel(function):
            self.library = library
            return self._executable(context, library, function, environment)
        library._ensure_finalized()
        return _dynfunc.make_function(function.lookup_module(), function.qualname, "part of a kernel", 0, environment, (library,))

    def wrap(self, make: Any, context: Any, library: Any, function: Any, *of: Any, **how: Any) -> None:
        """Add what Python, or a pointer, would call to a kernel's library; nothing calls a part so."""
        if self.is_kernel(function):
            make(context, library, function, *of, **how)

    def is_kernel(self, function: Any) -> bool:
        """By numba's description of it."""
        return (function.modname, function.qualname) == self.name


def _called(library: Any, found: dict[Any, None]) -> dict[Any, None]:
    """Libraries of all that a library's functions call, and that its parts do, each after those that it needs itself."""
    for called in library._linking_libraries:
        if called not in found:
            found[called] = None
            if getattr(called, "is_part", False):
                _called(called, found)
            found[called] = found.pop(called)
    return found


@cache
def _defaults(kind: Any) -> dict[str, Any]:
    """Of numba's options."""
    return {name: option.default for name, option in kind.options.items()}


def is_part(result: Any) -> bool:
    """Whether the result of a compilation was made to be linked only."""
    return getattr(result.library, "is_part", False)


def main() -> None:
    """Compile what is listed in the rows that come on standard input, each written to standard output when it is done."""
    gc.freeze()
    gc.set_threshold(GARBAGE, 10, 10)
    parts, kernels = LinkedParts(), json.loads(LISTED.read_text())
    parts.install()
    compiler_shortcuts.install()
    while row := os.read(0, ROW):
        with contextlib.suppress(Exception):  # what is not as listed is left to the run
            parts.compile(*kernel_of(*kernels[int.from_bytes(row, "little")]))
        os.write(1, row)
        gc.freeze()  # what is left numba keeps


if __name__ == "__main__":
    main()
