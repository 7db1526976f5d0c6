"""Comments behind the fields of dataclasses, for lists of options and schemas of recordings."""

from __future__ import annotations

import ast
import contextlib
import inspect
import io
import sys
import tokenize
from collections.abc import Iterator
from functools import lru_cache
from typing import Any


def field_comments(kind: type[Any]) -> dict[str, str]:
    """Return field name -> the comment behind it in the source, its bases' included; nothing where there is no source."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        with contextlib.suppress(OSError, TypeError, SyntaxError):
            module: Any = sys.modules.get(base.__module__)
            found |= _comments(_class_sources(inspect.getsource(module)).get(base.__qualname__, ""))
    return found


@lru_cache(maxsize=32)
def _class_sources(source: str) -> dict[str, str]:
    """Return qualified name -> lines of each class of a module; `inspect` would parse the module again for each of them."""
    lines = source.splitlines(keepends=True)

    def classes(node: ast.AST, prefix: str) -> Iterator[tuple[str, str]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef):
                yield prefix + child.name, "".join(lines[child.lineno - 1 : child.end_lineno])
                yield from classes(child, f"{prefix}{child.name}.")
            elif isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)):
                yield from classes(child, f"{prefix}{child.name}.<locals>.")
            elif isinstance(child, (ast.If, ast.Try, ast.With)):
                yield from classes(child, prefix)

    return dict(classes(ast.parse(source), ""))


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
