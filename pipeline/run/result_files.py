"""Read the files of a run folder, which may be a stranger's: JSON objects of limited size whose known keys hold what they should, and its words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.core.files import MAX_YAML_BYTES, SHOWN, YamlError, parse_yaml, read_text

MAX_BYTES = 64_000_000
LARGEST = 1e300  # of an integer, which JSON does not limit and a float does
NUMBER = (int, float)
EACH = "*"  # any other key
SURFACE_PART = {"mean_m": NUMBER, "within_5_cm": NUMBER}
KINDS: dict[str, Any] = {  # of metrics.json, timing.json, surface.json and job.json; what is not named here is not checked
    "frames": int,
    "status": {EACH: int},
    "reasons": {EACH: str},
    "note": str,
    "start_to_end_m": NUMBER,
    "final": {"share_basis": str, EACH: NUMBER},
    "causal": {"share_basis": str, EACH: NUMBER},
    "consistency": {},
    "sigma": {"share": {EACH: NUMBER}, EACH: NUMBER},
    "frame_ms": {EACH: NUMBER},
    "peak_memory_mb": NUMBER,
    "own_memory_mb": NUMBER,
    "stages": {EACH: {EACH: NUMBER}},
    "parts": {EACH: SURFACE_PART},
    "state": str,
    "error": str,
}
CURE = "run it again, or leave this folder out"


def read_results(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file of a run folder, nothing where there is no file. Raises DataError."""
    if not path.exists():
        return {}
    try:
        found: Any = json.loads(read_text(path, MAX_BYTES))
    except (ValueError, RecursionError) as error:
        raise DataError(str(path), f"is not JSON ({type(error).__name__})", CURE) from error
    _check(found, KINDS, path, "")
    results: dict[str, Any] = found
    return results


def read_words(path: Path) -> list[str]:
    """Return the words that a run was composed of, its `overrides.yaml`. Raises DataError."""
    try:
        words = parse_yaml(read_text(path, MAX_YAML_BYTES))
    except YamlError as error:
        raise DataError(str(path), f"is a text {error}", CURE) from error
    if not isinstance(words, list):
        raise DataError(str(path), "is not a list of words", CURE)
    return [str(word) for word in words]


def _check(value: Any, kind: Any, path: Path, key: str) -> None:
    """Check a value against a type, or an object against the kinds of its keys; null is no value."""
    if value is None and key:
        return
    if isinstance(kind, dict):
        if not isinstance(value, dict):
            raise DataError(str(path), f"holds {_quoted_name(key)}that is not an object", CURE)
        for name, item in value.items():
            if (found := kind.get(name, kind.get(EACH))) is not None:
                _check(item, found, path, f"{key}.{name}" if key else name)
    elif isinstance(value, bool) or not isinstance(value, kind) or (isinstance(value, int) and abs(value) > LARGEST):
        raise DataError(str(path), f"holds {_quoted_name(key)}of the wrong kind", CURE)


def _quoted_name(key: str) -> str:
    return f"'{printable(key, SHOWN)}' " if key else "a value "
