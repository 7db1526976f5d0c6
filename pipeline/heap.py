"""What the C library keeps of memory that is free. Of GNU's, that is; with any other nothing is done."""

from __future__ import annotations

import ctypes
from contextlib import suppress

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
