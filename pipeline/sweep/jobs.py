"""Files that a job of a sweep leaves in its folder besides the run's: the key of what it computed, and whether it came to its end."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import write_file
from trihedron.pipeline.core.registry import ENTRY_POINT_GROUP
from trihedron.pipeline.run.result_files import read_results

JOB = "job.json"
RUNNING, DONE, FAILED = "running", "done", "failed"
NOT_PART = ("hydra", "out", "report", "sequences", "alternatives", "dry_run")  # of what a job computes
SOURCES = ("pipeline", "plugins", "datasets")  # packages whose code decides on results
SEEDS = ("seed", "dataset.seed")  # options in which alone the repeats of a job differ
Job = dict[str, Any]


def key_of(config: DictConfig) -> str:
    """Hash of all that a run depends on: its composed configuration, the program's code, and names, sizes and times of the files it reads."""
    parts = DictConfig({name: value for name, value in config.items_ex(resolve=False) if name not in NOT_PART})
    values = OmegaConf.to_container(parts, resolve=True, enum_to_str=True)
    files = {text: _files(Path(text).expanduser()) for text in _texts(values) if text}
    return hashlib.sha256(json.dumps([values, code_version(), files], sort_keys=True).encode()).hexdigest()


@cache
def code_version() -> str:
    """Hash of the program's sources, and the names and versions of the packages that add plugins."""
    root = Path(__file__).parents[2]
    found = hashlib.sha256()
    for file in sorted(file for folder in SOURCES for file in (root / folder).rglob("*.py")):
        found.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    others = sorted(f"{entry.dist.name} {entry.dist.version}" for entry in entry_points(group=ENTRY_POINT_GROUP) if entry.dist)
    found.update(repr(others).encode())
    return found.hexdigest()


def _texts(values: Any) -> Iterator[str]:
    """Every text in nested lists and dictionaries."""
    if isinstance(values, str):
        yield values
    elif isinstance(values, (dict, list)):
        for value in values.values() if isinstance(values, dict) else values:
            yield from _texts(value)


@cache
def _files(path: Path) -> list[tuple[str, int, int]]:
    """Name, size and time of a file, or of all in a folder; nothing for a text that is no path. Relative names like `runs` are words, not paths."""
    if len(path.parts) < 2 or not path.exists():
        return []
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return [(file.relative_to(path).as_posix(), (state := file.stat()).st_size, state.st_mtime_ns) for file in files]


def write_job(folder: Path, key: str, state: str, error: str = "") -> None:
    """Say what is computed in a folder, and how far it came."""
    folder.mkdir(parents=True, exist_ok=True)
    write_file(folder / JOB, json.dumps({"key": key, "state": state, "error": error}, indent=2) + "\n")


def read_job(folder: Path) -> Job:
    """Read the last state of a job; empty where there never was one, or it cannot be read."""
    try:
        return read_results(folder / JOB)
    except DataError:  # a crash left it empty
        return {}
