"""Comments behind the fields of dataclasses, for lists of options and schemas of recordings."""

from __future__ import annotations

import contextlib
import inspect
import io
import tokenize
from typing import Any


def field_comments(kind: type[Any]) -> dict[str, str]:
    """Return field name -> the comment behind it in the source, its bases' included; nothing where there is no source."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        with contextlib.suppress(OSError, TypeError):
            found |= _comments(inspect.getsource(base))
    return found


def _comments(source: str) -> dict[str, str]:
    """Return field name -> comment of one class's source."""
    found, name = {}, ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.NAME and token.line[: token.start[1]].isspace() and token.line[token.end[1] :].lstrip().startswith(":"):
            name = token.string
        elif token.type == tokenize.COMMENT and name:
            found[name] = token.string.lstrip("# ")
            name = ""
        elif token.type == tokenize.NEWLINE:
            name = ""
    return found
