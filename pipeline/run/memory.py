"""Settings of the C library's allocator (GNU's; with any other nothing is done) and of the garbage collector."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_ARENA_MAX, _TRIM_THRESHOLD, _MMAP_THRESHOLD = -8, -1, -3  # M_ARENA_MAX and so on of malloc.h
RETAINED_BYTES = 64 << 20  # free at the heap's end before it is returned: the next frame needs what this one frees
MAPPED_BYTES = 8 << 20  # an array as large has a mapping of its own, which is returned with it


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
