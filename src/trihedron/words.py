"""Options of a Python call as words of the command line."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from os import PathLike, fspath
from typing import Any

from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.core.overrides import PATH_KEYS, quote


def words_of(overrides: tuple[str, ...], options: Mapping[str, Any]) -> list[str]:
    """Return the overrides, then a word for each option: `manhattan="mean_shift"`, `outputs=["surface"]`, `planes={"angle_deg": 3}` and
    `dataset__path=...`, where two underscores stand for a dot. Raises UsageError for a value that has no word."""
    for word in overrides:
        if not isinstance(word, str):
            raise UsageError(str(word), "is not an override", 'give text such as "manhattan.cone_deg=8", or manhattan="mean_shift"')
    return [*overrides, *(word for name, value in options.items() for word in _words(name.replace("__", "."), value))]


def _words(key: str, value: Any) -> list[str]:
    if isinstance(value, Mapping):
        return [word for name, item in value.items() for word in _words(f"{key}.{name}" if name != "plugin" else key, item)]
    if key in PATH_KEYS:
        return [f"{key}={fspath(value) if isinstance(value, PathLike) else value}"]
    return [f"{key}={_text(key, value)}"]


def _text(key: str, value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, PathLike):
        return quote(fspath(value))
    if isinstance(value, str):
        return quote(value) if value else "''"
    if isinstance(value, (list, tuple)):
        return f"[{','.join(_text(key, item) for item in value)}]"
    if hasattr(value, "item"):  # a number of NumPy's
        value = value.item()
    if isinstance(value, (int, float)):
        return repr(value)
    raise UsageError(key, f"is {type(value).__name__}, which no option takes", "give text, a number, True or False, or a list of these")
