"""Ctrl-C where something must be done whole."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Interrupts:
    """While this is entered, a Ctrl-C that comes in a `with self.held():` raises KeyboardInterrupt at the block's end, and any other at once, as
    always. Entering asks the system, holding does not. Off the main thread, and where others handle Ctrl-C, nothing changes."""

    count = 0  # of those that came to this process, for threads that wait for something

    def __init__(self) -> None:
        self._holding = self._came = self._handling = False

    def __enter__(self) -> Interrupts:
        self._handling = _on_main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if self._handling:
            signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: Any) -> None:
        if self._handling and _on_main_thread():
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def _handle(self, *_: Any) -> None:
        Interrupts.count += 1
        if not self._holding:
            raise KeyboardInterrupt
        self._came = True

    @contextmanager
    def held(self) -> Iterator[None]:
        """Do the block whole."""
        self._holding = True
        try:
            yield
        finally:
            self._holding = False
        if self._came:
            self._came = False
            raise KeyboardInterrupt


def _on_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
