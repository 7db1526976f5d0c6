"""The decorator of compiled functions, and the folder that caches their machine code.

A kernel is compiled by numba when it is first called with arguments of new types, and loaded from the cache in later processes. numba's own cache
compares the source file of a kernel only; this one compares every file that the kernel's module imports from the project, so that a change of a
called function or of an imported constant is noticed. The folders are named by module and content: environments with equal sources share them. A
wheel brings them along (`core.machine_code`).
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, overload

import numba
import numpy as np

from trihedron.pipeline.core.machine_code import BASELINE, archive, unpack

PACKAGE = __name__.partition(".")[0]
ROOT = Path(__file__).parents[2]  # of the package
IMPORTS = re.compile(rf"^(?:from ({PACKAGE}[\w.]*) import (\([^)]*\)|.*)|import ({PACKAGE}[\w.]*))", re.MULTILINE)
CONFIG: Any = numba.config

OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}  # of numba.njit
P = ParamSpec("P")
R = TypeVar("R")


@overload
def kernel(function: Callable[P, R], /) -> Callable[P, R]: ...


@overload
def kernel(**options: Any) -> Callable[[Callable[P, R]], Callable[P, R]]: ...


def kernel(function: Any = None, /, **options: Any) -> Any:
    """Compile a function with the project's options; `@kernel`, or `@kernel(forceinline=True)` with further options of `numba.njit`."""
    compiler = numba.njit(**{**OPTIONS, **options})
    return compiler if function is None else compiler(function)


def constant(array: Any, dtype: type[np.generic]) -> Any:
    """Return a contiguous read-only view of an array, or of a copy, for kernels. numba compiles a kernel anew for each mixture of read-only and
    writable arrays, which takes seconds; the arrays of topics are read-only."""
    view = np.ascontiguousarray(array, dtype).view()
    view.flags.writeable = False
    return view


def cache_folder() -> Path:
    """Folder of compiled kernels: NUMBA_CACHE_DIR, else `trihedron/kernels` in the user's cache folder (XDG_CACHE_HOME, else ~/.cache)."""
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    target = f"-{BASELINE}" if archive() is not None else ""
    return (Path(CONFIG.CACHE_DIR) if CONFIG.CACHE_DIR else user / PACKAGE / "kernels") / f"numba-{numba.__version__}{target}"


class KernelCache:
    """Cache locator of the project's kernels, for numba's option CACHE_LOCATOR_CLASSES; functions of other packages are cached where numba does."""

    def __init__(self, module: str, line: int) -> None:
        self._line, self._key = line, source_key(module)
        self._path = cache_folder() / f"{module.partition('.')[2]}-{self._key[:16]}"

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelCache | None:
        """Locate the cache of a function; None for one of another package, or where the folder cannot be written to."""
        if not py_func.__module__.startswith(f"{PACKAGE}."):
            return None
        locator = cls(py_func.__module__, py_func.__code__.co_firstlineno)
        try:
            locator.ensure_cache_path()
        except OSError:
            return None
        return locator

    def ensure_cache_path(self) -> None:
        """Make the folder, with what a wheel brings of it. Raises OSError where nothing can be written."""
        unpack(self._path)
        if not _writable(self._path):
            raise PermissionError(self._path)

    def get_cache_path(self) -> str:
        """Folder of the function's files."""
        return str(self._path)

    def get_source_stamp(self) -> str:
        """Hash of what was compiled; an index with another one is discarded."""
        return self._key

    def get_disambiguator(self) -> str:
        """Line of the function, which distinguishes functions of one name."""
        return str(self._line)


@cache
def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


@cache
def source_key(module: str) -> str:
    """SHA-256 (hexadecimal) of the module's source and those of all project modules that it imports, directly or not."""
    found: dict[str, bytes] = {}
    pending = {module}
    while pending:
        name = pending.pop()
        source, imported = _source(name)
        found[name] = source
        pending |= {other for other in imported if other not in found}
    digest = hashlib.sha256()
    for name, source in sorted(found.items()):
        digest.update(f"{name} {len(source)}\n".encode() + source)
    return digest.hexdigest()


@cache
def _source(module: str) -> tuple[bytes, frozenset[str]]:
    """Source of a module, and the names of the project's modules that its first column imports."""
    source = _file(module).read_bytes()
    imported: set[str] = set()
    for package, names, whole in IMPORTS.findall(source.decode()):
        imported |= {whole or package} | {f"{package}.{name}" for name in re.findall(r"\w+", names)}
    return source, frozenset(name for name in imported if _file(name).is_file())


def _file(module: str) -> Path:
    path = ROOT.joinpath(*module.split(".")[1:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


_OTHERS = CONFIG.CACHE_LOCATOR_CLASSES or "UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,IPythonCacheLocator,ZipCacheLocator"
if archive() is not None:
    CONFIG.CPU_NAME, CONFIG.CPU_FEATURES = BASELINE, ""  # of which LLVM knows the features
CONFIG.CACHE_LOCATOR_CLASSES = f"{__name__}.{KernelCache.__name__},{_OTHERS}"
