"""The WebSocket server to which Foxglove connects while a run goes on (foxglove-sdk). A client that is too slow loses its oldest messages."""

from __future__ import annotations

import threading
from typing import Any

import foxglove

from trihedron.pipeline.core.errors import ConfigError

HOST = "127.0.0.1"  # nobody but this machine
SHOWN = ("/view/", "/tf", "/error", "/timing")  # beginnings of the channels that are sent
BACKLOG = 256  # messages that wait for a client
CLOSING_S = 2.0  # that closing waits for clients to be disconnected


class FoxgloveServer:
    """A server on this machine. What is logged to channels of its context is sent to each client that has subscribed."""

    def __init__(self, port: int) -> None:
        """Open the port, 0 for any that is free. Raises ConfigError where it is in use."""
        self.context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="trihedron", host=HOST, port=port, context=self.context, channel_filter=_is_shown, message_backlog_size=BACKLOG
            )
        except (RuntimeError, OSError, OverflowError) as error:
            raise ConfigError("view.port", f"{port} cannot be opened: {error}", "give another view.port, 0 for any that is free") from error

    @property
    def url(self) -> str:
        """Return where a client connects."""
        return f"ws://localhost:{self._server.port}"

    def close(self) -> None:
        """Disconnect all clients. One that connected and says nothing keeps the server from stopping: it is left to the end of the process."""
        stopping = threading.Thread(target=self._server.stop, daemon=True)
        stopping.start()
        stopping.join(CLOSING_S)


def _is_shown(channel: Any) -> bool:
    return str(channel.topic).startswith(SHOWN)
