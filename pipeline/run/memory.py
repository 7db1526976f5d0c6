"""Settings of the C library's allocator (GNU's; with any other nothing is done) and of the garbage collector; limits of memory, and their errors."""

from __future__ import annotations

import ctypes
import gc
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from trihedron.pipeline.core.errors import DataError, printable

_ARENA_MAX, _TRIM_THRESHOLD, _MMAP_THRESHOLD = -8, -1, -3  # M_ARENA_MAX and so on of malloc.h
RETAINED_BYTES = 64 << 20  # free at the heap's end before it is returned: the next frame needs what this one frees
MAPPED_BYTES = 8 << 20  # an array as large has a mapping of its own, which is returned with it
IMPORT_BYTES = 1 << 30  # of address space, which the libraries take before the first frame; with half of it OpenCV's ends in a segmentation fault
EXHAUSTED = ("start new thread", "failed to map segment", "load shared object file", "Insufficient memory")  # in what libraries say of it
CURE = "give the process more (ulimit -v), fewer threads=N, or smaller images"


def check_address_space() -> None:
    """Raise DataError where the limit of the address space (`ulimit -v`) is below what importing the libraries takes."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < IMPORT_BYTES:
        cause = f"{limit >> 20} MB of address space are too few: the libraries alone take {IMPORT_BYTES >> 20} MB"
        raise DataError("memory", cause, f"raise the limit: ulimit -v {2 * IMPORT_BYTES >> 10}, or none")


def exhaustion(error: BaseException) -> DataError | None:
    """Return the error as one of memory (or threads) that ran out, or None if it is another."""
    if isinstance(error, MemoryError) or any(words in str(error) for words in EXHAUSTED):
        return DataError("memory", f"ran out ({printable(str(error), 160)})" if str(error) else "ran out", CURE)
    return None


def configure_malloc() -> None:
    """Let all threads that start from now on share one heap (arena), and retain the memory that a frame needs.

    With an arena each, every arena retains the most that its thread ever held at once, fragmented by the map: 30 MB of a run at 320×240. Threads
    seldom allocate at the same time, since most allocations hold the interpreter's lock. By default the library returns the images' memory to the
    system each time they are freed, and the system clears it again."""
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        for setting, value in ((_ARENA_MAX, 1), (_TRIM_THRESHOLD, RETAINED_BYTES), (_MMAP_THRESHOLD, MAPPED_BYTES)):
            library.mallopt(setting, value)


def malloc_trim() -> None:
    """Return free memory between allocations to the system (`malloc_trim`)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@contextmanager
def gc_paused() -> Iterator[None]:
    """Pause the garbage collector where nearly all that is allocated stays: imports, loading kernels. Collecting is a tenth of their time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()
