"""The program of rerun: its window, or a server of its web page with the data. A process, since only the program has an option for the address."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from trihedron.pipeline.core.errors import ConfigError, printable
from trihedron.pipeline.record.rerun_view import blueprint, require_rerun

PORT, WEB_PORT = 9876, 9090  # of the data, of the page
OPENING_S, ENDING_S = 20.0, 1.0
DISPLAYS = "DISPLAY", "WAYLAND_DISPLAY"


@dataclass(frozen=True)
class RerunViewer:
    """A stream to a viewer, and the link to its page; no link to a window."""

    stream: Any
    url: str = ""


def lacks_display() -> bool:
    """Return whether no window can open: Linux without X11 or Wayland."""
    return sys.platform == "linux" and not any(os.environ.get(name) for name in DISPLAYS)


@contextmanager
def opened_rerun(host: str, port: int, web_port: int | None) -> Iterator[RerunViewer]:
    """Open a page for the block, or, with `web_port` None, a window that stays; one that listens at `port` already is used.

    Raises LibraryError without rerun, ConfigError where nothing opens."""
    rerun = require_rerun()
    if web_port is None and lacks_display():
        raise ConfigError("view", f"there is no display ({' and '.join(DISPLAYS)} are not set)", "give view.web=true for a browser")
    stream = rerun.RecordingStream("trihedron")
    address = f"rerun+http://{host}:{port}/proxy"
    words = ["--bind", host, "--port", str(port), *(("--serve-web", "--web-viewer-port", str(web_port)) if web_port is not None else ())]
    process = None
    if web_port is not None or not _listens(host, port):
        for name, number in (("port", port), ("web_port", web_port)):
            if number is not None and _listens(host, number):
                raise ConfigError(f"view.{name}", f"{number} is in use", f"give another view.{name}")
        process = _started(words, host, [port] if web_port is None else [port, web_port])
    try:
        stream.connect_grpc(address, default_blueprint=blueprint())
        yield RerunViewer(stream, f"http://{host}:{web_port}?url={quote(address, safe='')}" if web_port is not None else "")
    finally:
        closing = threading.Thread(target=stream.disconnect, daemon=True)
        closing.start()
        closing.join(ENDING_S)  # to disconnect from a program that does not go on takes until that one has ended
        if process is not None and web_port is not None:
            _end(process)
        closing.join()


def _started(words: list[str], host: str, ports: list[int]) -> subprocess.Popen[bytes]:
    """The program, once it listens at its ports, in a session of its own: Ctrl-C is for the run."""
    command = [sys.executable, "-m", "rerun", *words]
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
        try:
            deadline = time.monotonic() + OPENING_S
            while not all(_listens(host, port) for port in ports):
                if process.poll() is not None or time.monotonic() > deadline:
                    log.seek(0)
                    lines = log.read().decode(errors="replace").strip().splitlines() or ["it printed nothing"]
                    raise ConfigError("view", f"rerun does not open: {printable(lines[-1])}", "give another view.host or view.port")
                time.sleep(0.05)
        except BaseException:
            _end(process)
            raise
        return process


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the program and the launcher that waits for it."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(ENDING_S)


def _listens(host: str, port: int) -> bool:
    with suppress(OSError), socket.create_connection((host, port), timeout=1.0):
        return True
    return False
