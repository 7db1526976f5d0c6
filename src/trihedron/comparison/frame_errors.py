"""The errors of every frame of an ablation's alternatives, and the file that keeps them: `N COLUMN` -> (frames,), N the number of the alternative."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import F64, OK, Trajectory
from trihedron.pipeline.run.accounting import Result
from trihedron.pipeline.run.metrics import frame_errors
from trihedron.pipeline.run.results import final_trajectory

Errors = dict[str, F64]  # of each frame (n,) by column, NaN where it has none


def of_result(result: Result, truth: Trajectory | None, columns: Mapping[str, tuple[str, float]]) -> Errors:
    """Return `ok %` of each frame of a run (100 or 0) and, with ground truth, the errors of its final trajectory; `columns` -> name in the metrics,
    factor. Empty where no pose was computed."""
    if not len(result.poses):
        return {}
    ok = {pose.stamp_ns for pose in result.poses if pose.status == OK}
    share = {"ok %": np.array([100.0 * (stamp in ok) for stamp in result.stamps_ns])}
    estimate = final_trajectory(result)
    if truth is None or not len(estimate):
        return share
    found = frame_errors(estimate, truth, result.fps, np.array(result.stamps_ns, np.int64))
    return share | {column: factor * found[name] for column, (name, factor) in columns.items() if name in found}


def errors_file(out: Path, key: str) -> Path:
    """Return the file of the errors of a recording's alternatives, by the key of its case in an ablation's folder."""
    return out / f"errors-{key[:16]}.npz"


def write_errors(file: Path, errors: Sequence[Errors]) -> None:
    """Write the errors of all alternatives of a recording. Raises DataError."""
    arrays = {f"{number} {column}": values for number, one in enumerate(errors) for column, values in one.items()}
    try:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # its stub takes the names for options
    except OSError as error:
        raise DataError(str(file), f"cannot be written: {error.strerror}", "give another out=DIR") from error


def read_errors(file: Path, count: int) -> list[Errors] | None:
    """Return the errors of `count` alternatives, None where the file is not there or is damaged."""
    found: list[Errors] = [{} for _ in range(count)]
    try:
        with np.load(file, allow_pickle=False) as arrays:
            for name in arrays.files:
                number, _, column = name.partition(" ")
                found[int(number)][column] = np.asarray(arrays[name], np.float64)
    except (OSError, EOFError, ValueError, IndexError, zipfile.BadZipFile):
        return None
    return found
