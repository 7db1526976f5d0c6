"""What the C library keeps of memory that is free (of GNU's, that is; with any other nothing is done), and when garbage is looked for."""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_MOST_HEAPS, _TRIM_THRESHOLD, _MMAP_THRESHOLD = -8, -1, -3  # M_ARENA_MAX and so on of malloc.h
KEPT_BYTES = 64 << 20  # free at the heap's end before it is given back: what a frame frees the next one asks for
MAPPED_BYTES = 8 << 20  # an array as large has memory of its own, which is given back with it


def settle() -> None:
    """Let all threads that are begun from now on share one heap, and keep what a frame needs. With one each, every heap keeps room for the most that
    its thread ever held at once, between what the map keeps: 30 MB of a run at 320×240. They seldom ask at the same time, since most of what asks
    holds the interpreter's lock. Left to itself, the library gives the images' memory back as often as they are freed, for the system to clear."""
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        for setting, value in ((_MOST_HEAPS, 1), (_TRIM_THRESHOLD, KEPT_BYTES), (_MMAP_THRESHOLD, MAPPED_BYTES)):
            library.mallopt(setting, value)


def give_back() -> None:
    """Give the system the memory that is free but lies between what is not."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@contextmanager
def growing() -> Iterator[None]:
    """Within this no garbage is looked for, where nearly all that is made stays: imports, what loads kernels. It is a tenth of their time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()
