"""Room on the interpreter's stack, for code that calls deeply."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
SLOTS = 2**17  # of 8 bytes: CPython maps 2 MB for such a frame, of which 1 MB stays for the calls within


def call_with_room(function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Call a function from a frame that reserves SLOTS of the interpreter's stack, and return its result.

    CPython keeps frames in chunks of 16 KB. Releases before March 2026 map the next chunk for each call at the end of one, and unmap it on return,
    however often that is (https://github.com/python/cpython/issues/142183), and numba's compiler calls 40 to 160 functions deep. The chunk of a
    large frame is large, so all calls within have room. What is reserved is never touched, so takes no memory."""
    return function(*args, **kwargs)


call_with_room.__code__ = call_with_room.__code__.replace(co_stacksize=SLOTS)
