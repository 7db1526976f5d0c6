"""The WebSocket server to which Foxglove connects while a run goes on (foxglove-sdk). A client that is too slow loses its oldest messages."""

from __future__ import annotations

import threading
from typing import Any

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from trihedron.pipeline.core.errors import ConfigError
from trihedron.pipeline.record.origin_gate import OriginGate, hidden_address

SHOWN = ("/view/", "/tf", "/error", "/timing")  # beginnings of the channels that are sent
IN_PARTS = ("/view/path",)  # channels whose messages add to each other; of any other, the last one replaces those before
BACKLOG = 256  # messages that wait for a client
CLOSING_S = 1.0  # that closing waits for clients to be disconnected
LOOPBACK = "127.0.0.1"


class FoxgloveServer(ServerListener):
    """A server. What is logged to channels of its context is sent to each client that has subscribed, but no page of a foreign web site. After the
    run's end a client that subscribes gets what was last shown."""

    def __init__(self, port: int, host: str = LOOPBACK) -> None:
        """Listen on the address `host` and a port, 0 for any that is free. Raises ConfigError where that cannot be."""
        self.context, self._host = foxglove.Context(), host
        self._last: dict[int, list[tuple[foxglove.Channel, bytes]]] = {}  # number of a channel -> what was last shown there
        self._last_ns = 0
        self._ended = False
        try:
            hidden = hidden_address()
            self._server = foxglove.start_server(
                name="trihedron",
                host=hidden,
                port=0,
                context=self.context,
                channel_filter=_is_shown,
                message_backlog_size=BACKLOG,
                server_listener=self,
            )
            self._gate = OriginGate((host, port), (hidden, self._server.port))
        except (RuntimeError, OSError, OverflowError) as error:
            cure = "give another view.port, 0 for any that is free"
            raise ConfigError("view.port", f"{port} cannot be opened: {error}", cure if host == LOOPBACK else f"{cure}, or view.host") from error

    @property
    def url(self) -> str:
        """Return where a client connects."""
        return f"ws://{f'[{self._host}]' if ':' in self._host else self._host}:{self._gate.port}"

    def remember(self, channel: foxglove.Channel, log_time: int, data: bytes) -> None:
        """Hold what a channel was sent, for clients that come after the run."""
        if _is_shown(channel):
            parts = self._last.setdefault(channel.id(), [])
            if channel.topic() not in IN_PARTS:
                parts.clear()
            parts.append((channel, data))
            self._last_ns = log_time

    def end_run(self) -> None:
        """Send each client that subscribes from here on what was last shown. Call it when no file is written any more."""
        self._ended = True

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send what was last shown, to every client of the channel: the library names no single one."""
        for own, data in self._last.get(channel.id, ()) if self._ended else ():
            own.log(data, log_time=self._last_ns)

    def close(self) -> None:
        """Disconnect all clients, with a word of goodbye to those that listen."""
        stopping = threading.Thread(target=self._server.stop, daemon=True)
        stopping.start()
        stopping.join(CLOSING_S)
        self._gate.close()


def _is_shown(channel: Any) -> bool:
    topic = channel.topic
    return str(topic() if callable(topic) else topic).startswith(SHOWN)
