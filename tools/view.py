"""Open a run in rerun: frames, features, planes, axes, the map, the surface and the estimate against the truth.

Needs rerun: pip install 'trihedron[view]'. `trihedron export RUN --to rerun` writes the same to a file.

Example: trihedron view runs/latest
"""

from __future__ import annotations

from pathlib import Path

from trihedron.pipeline.app.recorded_values import open_recording
from trihedron.pipeline.core.errors import UsageError
from trihedron.tools.arguments import Parser
from trihedron.tools.export import RECORDING


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises LibraryError without rerun, UsageError where its window does not open, RecordingError for a
    file that cannot be read."""
    from trihedron.pipeline.record.rerun_view import require_rerun
    from trihedron.tools.export_rerun import show

    parser = Parser("view", __name__)
    parser.add_argument("run", metavar="RUN", type=Path, help="a run folder or its recording")
    run: Path = parser.parse_args(argv).run
    rerun = require_rerun()
    recording = open_recording(run / RECORDING if run.is_dir() else run)
    stream = rerun.RecordingStream("trihedron")
    try:
        stream.spawn()
        count = show(recording, stream)
        stream.flush()
    except RuntimeError as error:  # there is no display, for example
        raise UsageError(
            "rerun", f"its window does not open: {str(error).strip().splitlines()[0]}", f"write a file instead: trihedron export {run} --to rerun"
        ) from error
    print(f"{count} frames of {recording.path}")
    return 0
