"""Open a run in rerun: frames, features, planes, axes, the map, the surface and the estimate against the truth.

Needs rerun: pip install 'trihedron[view]'. A recording that is being written is
followed until its run ends. --web serves it to a browser until Ctrl-C, and needs no
display.
`trihedron export RUN --to rerun` writes the same to a file.

Example: trihedron view runs/latest
Example: trihedron view runs/latest --web
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

from trihedron.pipeline.app.recorded_values import open_recording
from trihedron.pipeline.app.viewers import keep_serving
from trihedron.pipeline.core.errors import RecordingError, UsageError
from trihedron.pipeline.record.mcap_file import in_use, recording_file
from trihedron.pipeline.record.reader import Recording
from trihedron.tools.arguments import Parser

POLL_S = 0.5  # between two readings of a recording that is being written


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises LibraryError without rerun, UsageError where there is no display, ConfigError where nothing
    opens, RecordingError for a file that cannot be read."""
    from trihedron.pipeline.record.foxglove_server import LOOPBACK
    from trihedron.pipeline.record.rerun_view import require_rerun
    from trihedron.pipeline.record.rerun_viewer import PORT, WEB_PORT, lacks_display, opened_rerun

    parser = Parser("view", __name__)
    parser.add_argument("run", metavar="RUN", type=Path, help="a run folder or its recording")
    parser.add_argument("--web", action="store_true", help="serve it to a browser")
    parser.add_argument("--host", default=LOOPBACK, help="the address to listen on (default: 127.0.0.1, this machine alone)")
    parser.add_argument("--port", type=int, default=PORT, help="of the data (default: 9876)")
    parser.add_argument("--web-port", type=int, default=WEB_PORT, help="of the page (default: 9090)")
    arguments = parser.parse(argv)
    run: Path = arguments.run
    require_rerun()
    path = recording_file(run)
    growing = in_use(path)  # asked first: a run may end meanwhile
    recording = open_recording(path, announce=False)
    if lacks_display() and not arguments.web:
        raise UsageError("view", "there is no display for rerun's window", f"serve it to a browser: trihedron view {run} --web")
    with opened_rerun(arguments.host, arguments.port, arguments.web_port if arguments.web else None) as viewer:
        try:
            print(f"{_show_to_its_end(recording, growing, viewer.stream, viewer.url)} frames of {recording.path}")
        except KeyboardInterrupt:
            return 0
        except RuntimeError as error:  # the window was closed, for example
            raise UsageError(
                "rerun", f"does not take the run: {str(error).strip().splitlines()[0]}", f"write a file instead: trihedron export {run} --to rerun"
            ) from error
        if viewer.url:
            keep_serving(viewer.url)
    return 0


def _show_to_its_end(recording: Recording, growing: bool, stream: Any, url: str) -> int:
    """Show a recording, and of one that is growing what is added until nobody writes any more; returns the number of frames."""
    from trihedron.tools.export_rerun import show

    path = recording.path
    count = show(recording, stream)
    stream.flush()
    if growing:
        print(f"view: {count} frames so far{f' at {url}' if url else ''}; new ones are shown until the run ends", flush=True)
    while growing:
        time.sleep(POLL_S)
        growing = in_use(path)  # asked first: the last reading has everything
        after = recording.references[-1].index - 1  # the last frame may not have been whole
        try:
            recording = open_recording(path, announce=False)
        except RecordingError as error:  # of a run that was killed, for example
            print(f"trihedron: {error}", file=sys.stderr)
            break
        count = show(recording, stream, after)
        stream.flush()
    return count
