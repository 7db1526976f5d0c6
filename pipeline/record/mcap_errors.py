"""What to say of an MCAP file that cannot be read."""

from __future__ import annotations

import fcntl
import struct
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.writer import MCAP0_MAGIC

from trihedron.pipeline.core.errors import RecordingError
from trihedron.pipeline.record.chunk_writer import is_being_written

DAMAGE = (McapError, ValueError, EOFError, AssertionError, KeyError, struct.error, zstandard.ZstdError, RuntimeError, OverflowError, MemoryError)
"""What the library raises for damaged bytes."""


def damaged(path: Path | str) -> RecordingError:
    """Why a file cannot be read as MCAP, and what helps: it is none, is still being written, was cut off or damaged."""
    try:
        with open(path, "rb") as file:
            start = file.read(len(MCAP0_MAGIC))
            if start != MCAP0_MAGIC[: len(start)] or not start:
                return RecordingError(str(path), "is not an MCAP file", "give a file that trihedron run or another MCAP writer wrote")
            if is_being_written(file.fileno(), fcntl.LOCK_SH):
                return RecordingError(str(path), "is still being written", "wait until its run has ended")
            file.seek(-min(len(MCAP0_MAGIC), file.seek(0, 2)), 2)
            whole = file.read() == MCAP0_MAGIC
    except OSError as error:
        return RecordingError(str(path), f"cannot be read: {error.strerror}", "give the path of an MCAP file")
    cause = "is damaged" if whole else "is not a complete MCAP file: what wrote it was cut off"
    return RecordingError(str(path), cause, f"rescue what is whole with: trihedron recover {path}")
