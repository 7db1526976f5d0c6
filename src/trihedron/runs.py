"""Runs and their comparison, as the command line makes them."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from trihedron.buildings import Building
from trihedron.comparison.runs import read_runs, rows_of
from trihedron.pipeline.app.cli import RUN_FLAGS, run_once
from trihedron.pipeline.core.errors import UsageError
from trihedron.pipeline.run.results import flatten_dict
from trihedron.recording import Recording
from trihedron.trajectory import Trajectory
from trihedron.words import words_of


@dataclass(frozen=True)
class Run:
    """A finished run: its folder, and its metrics as in metrics.json."""

    folder: Path
    metrics: dict[str, Any]

    @cached_property
    def recording(self) -> Recording:
        """The recording of every topic."""
        return Recording(self.folder)

    @property
    def trajectory(self) -> Trajectory:
        """The final trajectory."""
        return self.recording.trajectory

    @property
    def building(self) -> Building:
        """The plan of the building."""
        return self.recording.building

    def table(self) -> Any:
        """Return the metrics, one row a figure: a pandas DataFrame where pandas is installed, else a list of dicts."""
        rows = [{"figure": name, "value": value} for name, value in flatten_dict(self.metrics).items()]
        return as_table(rows)


def run(*overrides: str, out: str | Path | None = None, quiet: bool = False, **options: Any) -> Run:
    """Track a data set, or replay a recording, as `trihedron run` does: `run("dataset=tum", "dataset.path=...", threads=2)`.

    Args:
        overrides: words of the command line.
        out: the run folder; runs/<date>/<time> without it.
        quiet: print nothing but warnings.
        options: root keys and plugins by name; two underscores stand for a dot, as `dataset__path="..."`.

    Raises TrihedronError, one line."""
    words = words_of(overrides, options)
    if flag := next((word for word in words if word in RUN_FLAGS), None):
        raise UsageError(flag, "is a sweep, which is no single run", "start it with: trihedron run -m ...")
    with ExitStack() as stack:
        if quiet:
            stack.enter_context(redirect_stdout(stack.enter_context(open(os.devnull, "w"))))
        folder, metrics = run_once([*words, *([f"out={Path(out).expanduser()}"] if out is not None else [])], time.perf_counter())
    return Run(folder, metrics)


def compare(folders: Iterable[str | Path | Run] | str | Path, baseline: str = "") -> Any:
    """Compare runs, or the jobs of sweeps: a row for each data set and change, with the median of each figure over its runs.

    Returns a pandas DataFrame where pandas is installed, else a list of dicts. Raises TrihedronError where a folder holds no runs."""
    given: Sequence[Any] = [folders] if isinstance(folders, (str, Path, Run)) else list(folders)
    paths = [item.folder if isinstance(item, Run) else Path(item).expanduser() for item in given]
    rows = rows_of([found for path in paths for found in read_runs(path)], baseline)
    return as_table([_flat(row) for row in rows])


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    figures = {name: figure["median"] for name, figure in row["figures"].items()}
    differences = {f"Δ {name}": difference["mean"] for name, difference in row["difference"].items()}
    return {"data": row["data"], "change": row["change"], "runs": row["runs"], **figures, **differences, "note": row["note"]}


def as_table(rows: list[dict[str, Any]]) -> Any:
    """Return rows as a pandas DataFrame where pandas is installed, else as they are."""
    try:
        import pandas
    except ImportError:
        return rows
    return pandas.DataFrame(rows)
