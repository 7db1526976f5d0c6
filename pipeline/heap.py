"""What the C library keeps of memory that is free. Of GNU's, that is; with any other nothing is done."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_MOST_HEAPS = -8  # M_ARENA_MAX of malloc.h


def share() -> None:
    """Let all threads that are begun from now on share one heap. With one each, every heap keeps room for the most that its thread ever held at once,
    between what the map keeps: 30 MB of a run at 320×240. They seldom ask at the same time, since most of what asks holds the interpreter's lock."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(_MOST_HEAPS, 1)


def give_back() -> None:
    """Give the system the memory that is free but lies between what is not."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
