"""The viewer that `view=` chooses: opened before anything is compiled, closed at the end of the run or when the user ends it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from omegaconf import DictConfig

from trihedron.pipeline.record.foxglove_server import FoxgloveServer
from trihedron.pipeline.record.rerun_viewer import opened_rerun
from trihedron.pipeline.run.interrupts import wait_for_the_end
from trihedron.pipeline.run.rerun_sink import RerunSink

PREVIEW_FRAMES = 60  # between two meshes that a viewer is shown


@dataclass(frozen=True)
class Viewer:
    """Foxglove's server, sinks of other viewers, the link under which it is served, if it is, and the frames between two previews of folds
    (0: nobody looks)."""

    server: FoxgloveServer | None = None
    sinks: tuple[RerunSink, ...] = ()
    url: str = ""

    @property
    def preview_period(self) -> int:
        """Return the frames between two previews of a fold."""
        return PREVIEW_FRAMES if self.server is not None or self.sinks else 0

    def keep(self) -> None:
        """Serve what was shown until the user ends it. Returns at once where nothing is served."""
        if self.server is not None:
            self.server.end_run()
        if self.url:
            keep_serving(self.url, "view.keep=false ends it with the run")


@contextmanager
def opened_viewer(config: DictConfig) -> Iterator[Viewer]:
    """Open the chosen viewer for the block. Raises ConfigError where it cannot be opened, UsageError where its package is missing."""
    options = config.get("view")
    chosen = str(options.viewer) if options is not None else ""
    if chosen == "foxglove":
        server = FoxgloveServer(int(options.port), str(options.host))
        print(f"view: open {server.url} in Foxglove (Open connection, Foxglove WebSocket); the layout is docs/foxglove_layout.json", flush=True)
        try:
            yield Viewer(server, url=server.url)
        finally:
            server.close()
    elif chosen == "rerun":
        with opened_rerun(str(options.host), int(options.port), int(options.web_port) if options.web else None) as viewer:
            if viewer.url:
                print(f"view: open {viewer.url} in a browser", flush=True)
            sink = RerunSink(viewer.stream)
            try:
                yield Viewer(sinks=(sink,), url=viewer.url)
            finally:
                sink.close()
    else:
        yield Viewer()


def keep_serving(url: str, remark: str = "") -> None:
    """Wait until Ctrl-C or SIGTERM, the announced ways to end."""
    wait_for_the_end(f"view: {url} is served until Ctrl-C or SIGTERM" + (f"; {remark}" if remark else ""))
