"""Signals that ask the program to end: SIGINT (Ctrl-C), SIGTERM and SIGHUP, and blocks that they do not cut in two."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interruption(KeyboardInterrupt):
    """A signal asks the program to end. `exit_code` is 128 + its number: 143 for SIGTERM, 129 for SIGHUP."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


def interrupt(number: int, *_: Any) -> None:
    """Handle SIGTERM or SIGHUP as Python handles SIGINT: raise in the main thread."""
    raise KeyboardInterrupt if number == signal.SIGINT else Interruption(number)


@contextmanager
def ending_signals_interrupt() -> Iterator[None]:
    """Within it SIGTERM and SIGHUP interrupt the program as SIGINT does. One that is ignored (nohup) or that others handle stays as it is. Afterwards
    all three are handled as before."""
    before = {number: signal.getsignal(number) for number in ENDING if _on_main_thread() and signal.getsignal(number) is not None}
    for number, handler in before.items():
        if number != signal.SIGINT and handler is signal.SIG_DFL:
            signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def wait_for_the_end(announcement: str) -> None:
    """Print how the program is ended, and return when a signal asks for that, however soon. Further ones change nothing: what is left is to close
    (`timeout` and a second Ctrl-C send two)."""
    ended = threading.Event()
    for number in ENDING if _on_main_thread() else ():
        if signal.getsignal(number) in (signal.default_int_handler, interrupt):
            signal.signal(number, lambda *_: ended.set())
    print(announcement, flush=True)
    ended.wait()


class Interrupts:
    """While this is entered, a signal that comes in a `with self.defer():` raises KeyboardInterrupt at the block's end, and any other at once, as
    always. Entering asks the system, holding does not. Off the main thread, and for signals that others handle, nothing changes."""

    count = 0  # of those that came to this process, for threads that wait for something

    def __init__(self) -> None:
        self._holding, self._came = False, 0
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        if _on_main_thread():
            handlers = {number: signal.getsignal(number) for number in ENDING}
            self._handlers = {number: handler for number, handler in handlers.items() if handler in (signal.default_int_handler, interrupt)}
            for number in self._handlers:
                signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: Any) -> None:
        if _on_main_thread():
            for number, handler in self._handlers.items():
                signal.signal(number, handler)

    def _handle(self, number: int, *_: Any) -> None:
        Interrupts.count += 1
        if not self._holding:
            interrupt(number)
        self._came = number

    @contextmanager
    def defer(self) -> Iterator[None]:
        """Do the block whole."""
        self._holding = True
        try:
            yield
        finally:
            self._holding = False
        if self._came:
            number, self._came = self._came, 0
            interrupt(number)


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Do the block whole: a signal that asks the program to end is handled at its end."""
    with Interrupts() as interrupts, interrupts.defer():
        yield


def _on_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
