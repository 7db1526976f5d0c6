"""A door before a WebSocket server of this machine: connections that pages of foreign web sites open are refused, all others are passed on.

A browser lets any page open a WebSocket to any address, and states in the header `Origin` whose page it is. It is for the server to look at that
(RFC 6455, section 10.2), and foxglove-sdk does not. What stands behind the door listens on an address of its own that nobody can guess."""

from __future__ import annotations

import secrets
import socket
import socketserver
import sys
import threading
import time
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

WEB = ("http", "https")  # schemes of web pages; programs have others, or none
OWN_HOSTS = ("localhost", "127.0.0.1", "::1")
FOXGLOVE = "foxglove.dev"  # whose page is the viewer
NO_ORIGIN = "null"  # of pages that hide theirs
HEAD_BYTES, HEAD_S = 16_384, 10.0  # of the request, and how long it may take
GOODBYE_S = 1.0  # that what is on its way may take when the door closes
PIECE = 1 << 16
REFUSED = b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


def hidden_address() -> str:
    """Return an address of this machine's loopback network at random, of 2^24 on Linux."""
    return ".".join(["127", *(str(1 + secrets.randbelow(254)) for _ in range(3))]) if sys.platform == "linux" else "127.0.0.1"


def is_allowed(origin: str) -> bool:
    """Return whether a request with this `Origin` (empty: without one) may connect: a program, a page of this machine, or Foxglove's."""
    try:
        parts = urlsplit(origin)
        host = parts.hostname or ""
    except ValueError:
        return False
    foxglove = parts.scheme == "https" and (host == FOXGLOVE or host.endswith(f".{FOXGLOVE}"))
    return origin != NO_ORIGIN and (parts.scheme not in WEB or host in OWN_HOSTS or foxglove)


class OriginGate(socketserver.ThreadingTCPServer):
    """Listens on an address, and passes what `is_allowed` lets in on to another."""

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, address: tuple[str, int], behind: tuple[str, int]) -> None:
        """Raises OSError, or OverflowError for a port that is none, where the address cannot be opened."""
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, _Visit)
        self.behind = behind
        self.open: set[socket.socket] = set()
        threading.Thread(target=self.serve_forever, name="origin gate", daemon=True).start()

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self.server_address[1])

    def close(self) -> None:
        """Refuse new connections, let those that there are pass on what is on its way, and end them."""
        self.shutdown()
        self.server_close()
        deadline = time.monotonic() + GOODBYE_S
        while self.open and time.monotonic() < deadline:
            time.sleep(0.01)
        for connection in tuple(self.open):
            _end(connection)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: a connection that breaks is over."""


class _Visit(socketserver.BaseRequestHandler):
    """One connection, in a thread of its own."""

    server: OriginGate

    def handle(self) -> None:
        self.server.open.add(self.request)
        try:
            self.request.settimeout(HEAD_S)
            head = self._head()
            if head and not is_allowed(_origin(head)):
                self.request.sendall(REFUSED)
            elif head:
                self._pass_on(head)
        finally:
            self.server.open.discard(self.request)

    def _head(self) -> bytes:
        """Return the request as far as its empty line; empty where none comes in time."""
        head = b""
        with suppress(OSError):
            while b"\r\n\r\n" not in head and len(head) < HEAD_BYTES:
                piece = self.request.recv(PIECE)
                if not piece:
                    return b""
                head += piece
        return head if b"\r\n\r\n" in head else b""

    def _pass_on(self, head: bytes) -> None:
        with socket.create_connection(self.server.behind) as inside:
            self.request.settimeout(None)
            inside.sendall(head)
            inwards = threading.Thread(target=_copy, args=(self.request, inside), daemon=True)
            inwards.start()
            _copy(inside, self.request)
            inwards.join()


def _origin(head: bytes) -> str:
    lines = head.partition(b"\r\n\r\n")[0].decode("latin-1").split("\r\n")[1:]
    named = [value.strip() for name, _, value in (line.partition(":") for line in lines) if name.strip().lower() == "origin"]
    return named[0] if len(named) == 1 else NO_ORIGIN if named else ""


def _copy(source: socket.socket, target: socket.socket) -> None:
    """Pass on what comes until either side ends."""
    with suppress(OSError):
        while piece := source.recv(PIECE):
            target.sendall(piece)
    _end(source)
    _end(target)


def _end(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
