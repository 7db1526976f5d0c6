"""The viewer that `view=` chooses: opened before anything is compiled, closed at the end of the run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from omegaconf import DictConfig

from trihedron.pipeline.core.errors import ConfigError
from trihedron.pipeline.record.foxglove_server import FoxgloveServer
from trihedron.pipeline.record.rerun_view import blueprint, require_rerun
from trihedron.pipeline.run.rerun_sink import RerunSink

PREVIEW_FRAMES = 60  # between two meshes that a viewer is shown


@dataclass(frozen=True)
class Viewer:
    """Foxglove's server, sinks of other viewers, and the frames between two previews of folds (0: nobody looks)."""

    server: FoxgloveServer | None = None
    sinks: tuple[RerunSink, ...] = ()

    @property
    def preview_period(self) -> int:
        """Return the frames between two previews of a fold."""
        return PREVIEW_FRAMES if self.server is not None or self.sinks else 0


@contextmanager
def opened_viewer(config: DictConfig) -> Iterator[Viewer]:
    """Open the chosen viewer for the block. Raises ConfigError where it cannot be opened, UsageError where its package is missing."""
    chosen = str(config.view.viewer) if config.get("view") is not None else ""
    if chosen == "foxglove":
        server = FoxgloveServer(int(config.view.port))
        print(f"view: open {server.url} in Foxglove (Open connection, Foxglove WebSocket); the layout is docs/foxglove_layout.json", flush=True)
        try:
            yield Viewer(server)
        finally:
            server.close()
    elif chosen == "rerun":
        sink = RerunSink(_rerun_stream(config.view))
        try:
            yield Viewer(sinks=(sink,))
        finally:
            sink.close()
    else:
        yield Viewer()


def _rerun_stream(options: Any) -> Any:
    """A stream to a viewer: a window, or a web page that is served."""
    rerun = require_rerun()
    stream = rerun.RecordingStream("trihedron")
    try:
        if options.web:
            url = stream.serve_grpc(grpc_port=options.port, default_blueprint=blueprint())
            rerun.serve_web_viewer(web_port=options.web_port, open_browser=False, connect_to=url)
            print(f"view: open http://localhost:{options.web_port}?url={url} in a browser", flush=True)
        else:
            stream.spawn(port=options.port, default_blueprint=blueprint())
    except (RuntimeError, OSError) as error:  # no display, a port in use
        raise ConfigError("view", f"rerun cannot be opened: {error}", "give view.web=true for a browser, or another view.port") from error
    return stream
