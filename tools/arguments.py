"""The argument parser of the commands, whose mistakes are the program's one-line errors."""

from __future__ import annotations

import argparse
import inspect
import sys
from collections.abc import Iterable, Sequence
from typing import NoReturn

from trihedron.pipeline.core.errors import UsageError, did_you_mean


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose mistakes are UsageErrors. Its text is the docstring of the command's module: first line, then the rest."""

    def __init__(self, command: str, module: str) -> None:
        text = inspect.getdoc(sys.modules[module])
        super().__init__(f"trihedron {command}", description=text, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)

    def add_parts(self, parts: Iterable[str]) -> None:
        """Add --parts A,B: which of `parts` to run, as a list; all by default. Another word raises UsageError."""
        known = list(parts)

        def some(text: str) -> list[str]:
            for part in text.split(","):
                if part not in known:
                    raise UsageError(self.prog.removeprefix("trihedron "), f"there is no part '{part}'", did_you_mean(part, known))
            return text.split(",")

        every = ",".join(known)
        self.add_argument("--parts", type=some, default=every, metavar="A,B", help=f"some of them (default: {every})")

    def parse(self, argv: Sequence[str]) -> argparse.Namespace:
        """Return the arguments; options may stand between words. Raises UsageError."""
        return self.parse_intermixed_args(argv)

    def error(self, message: str) -> NoReturn:
        """Raise UsageError, with the command's own help as the cure."""
        raise UsageError(self.prog.removeprefix("trihedron "), message, f"see {self.prog} --help")
