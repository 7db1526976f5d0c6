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

    def __repr__(self) -> str:
        status = ", ".join(f"{count} {name}" for name, count in self.metrics.get("status", {}).items() if count)
        ate_m = self.metrics.get("final", {}).get("ate_rmse_m")
        return f"Run({'; '.join([str(self.folder), *([status] if status else []), *([f'ATE {1e3 * ate_m:.3g} mm'] if ate_m is not None else [])])})"

    def table(self) -> Any:
        """Return the metrics, one row a figure, as `figure` and `value`: a pandas DataFrame where pandas is installed, else a list of dicts."""
        rows = [{"figure": name, "value": value} for name, value in flatten_dict(self.metrics).items()]
        return as_table(rows)


def run(*overrides: str, out: str | Path | None = None, quiet: bool = False, **options: Any) -> Run:
    """Track a data set, or replay a recording, as `trihedron run` does: `run("dataset=tum", "dataset.path=...", threads=2)`.

    Args:
        overrides: words of the command line.
        out: the run folder; runs/<date>/<time> without it.
        quiet: print nothing but warnings.
        options: root keys and plugins by name; two underscores stand for a dot, as `dataset__path="..."`.

    Returns:
        The finished run: its folder and its metrics, and through them its recording.

    Raises:
        UsageError: a word is no override, is of a sweep, or holds a value that no option takes.
        ConfigError: a key, plugin or option is unknown, an option out of range, or the folder cannot be written.
        GraphError: the wires of the graph do not fit together.
        DataError: the data set cannot be read, or another run writes to the folder.
        RecordingError: the recording to replay cannot be read, or lacks what the stages need.
        StageError: a stage failed.

    Examples:
        >>> import trihedron as th
        >>> run = th.run("dataset.length=6", "dataset.width=160", dataset__height=120, manhattan="mean_shift", out="runs/mine", quiet=True)
        >>> run.metrics["status"]
        {'ok': 6, 'degraded': 0, 'lost': 0}
        >>> run.recording.frames
        (0, 1, 2, 3, 4, 5)
    """
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

    Args:
        folders: run folders, folders of sweeps, or runs; runs that differ in their seeds alone share a row.
        baseline: the `change` of the row from which the others' differences are taken, paired by data set and seeds; none without it.

    Returns:
        A pandas DataFrame where pandas is installed, else a list of dicts: `data`, `change`, `runs`, the figures, their mean differences from the
            baseline as `Δ figure`, and `note`.

    Raises:
        DataError: a folder does not exist, or holds no runs.
        UsageError: no row is the baseline.

    Examples:
        >>> import trihedron as th
        >>> words = ["dataset.length=3", "dataset.width=160", "dataset.height=120", "outputs=[planes]"]
        >>> runs = [th.run(*words, planes=name, out=f"runs/{name}", quiet=True) for name in ("ransac", "cape")]
        >>> table = th.compare(runs)
        >>> rows = table if isinstance(table, list) else table.to_dict("records")
        >>> [row["change"] for row in rows]
        ['planes=ransac', 'planes=cape']
    """
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
