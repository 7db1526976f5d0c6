"""Give a recording that was cut off, or damaged, its index again: every message that is whole is copied, with metadata and attachments.

Works on any MCAP file. What never reached the disk cannot be known. Without --out the file itself is replaced, once the new one is complete.

Example: trihedron recover runs/latest/run.mcap
"""

from __future__ import annotations

from pathlib import Path

from trihedron.pipeline.record.rescue import recover
from trihedron.tools.arguments import Parser


def main(argv: list[str]) -> int:
    """Run the command; returns the exit code. Raises RecordingError for a file that is missing, in use or no MCAP, DataError where nothing can be
    written."""
    parser = Parser("recover", __name__)
    parser.add_argument("file", metavar="FILE.mcap", type=Path)
    parser.add_argument("--out", metavar="FILE", type=Path, help="write this file and leave the other as it is")
    arguments = parser.parse(argv)
    out: Path = arguments.out or arguments.file
    print(f"{out}: {recover(arguments.file, out)}")
    return 0
