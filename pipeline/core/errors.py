"""Errors for people: one line with the place, the cause and the cure.

Every error a user can provoke is a `TrihedronError`; the command line prints it as
`trihedron: <place>: <cause>; <cure>` and exits with its `exit_code`. Anything else is a defect of the program.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class TrihedronError(Exception):
    """An error with a place (file, key, stage), a cause and a cure; printed as one line.

    Its kinds are UsageError, ConfigError, GraphError, PluginError, DataError, RecordingError, LibraryError and StageError, in
    `trihedron.pipeline.core.errors`; `except trihedron.TrihedronError` catches them all.

    Args:
        place: where it is: a file, a key, an argument or a stage.
        cause: what is wrong there.
        cure: what to do; none where it is empty.
    """

    exit_code = 1

    def __init__(self, place: str, cause: str, cure: str = "") -> None:
        self.place, self.cause, self.cure = place, cause, cure
        super().__init__(printable(f"{place}: {cause}" + (f"; {cure}" if cure else "")))  # one line, whatever a file is called or holds


class UsageError(TrihedronError):
    """A word of the command line is wrong (exit code 2)."""

    exit_code = 2


class ConfigError(TrihedronError):
    """A value of the configuration is unknown, of the wrong type or out of range."""


class GraphError(TrihedronError):
    """The graph's wires do not fit together."""


class PluginError(TrihedronError):
    """A plugin breaks its slot's contract or does not load."""


class DataError(TrihedronError):
    """A data set, camera file or trajectory cannot be used."""


class RecordingError(TrihedronError):
    """A recording lacks a requested topic or frame, is damaged or of another version."""


class LibraryError(TrihedronError):
    """A library that is imported when it is needed is not installed, or does not load."""


class StageError(TrihedronError):
    """A stage failed while the pipeline ran."""


def printable(text: str, limit: int = 4000) -> str:
    """A text from a file as one line that may go to a terminal: what cannot be printed becomes `?`, and beyond `limit` characters it ends in `…`."""
    shown = text if len(text) <= limit else text[: max(limit - 1, 0)] + "…"
    return shown if shown.isprintable() else "".join(c if c.isprintable() else "?" for c in shown)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the cure for an unknown name: the closest known one, or the list of them all."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if close:
        return f"did you mean '{close[0]}'?"
    return f"known: {', '.join(known)}" if known else "none is known"
