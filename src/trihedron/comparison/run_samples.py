"""Runs as samples of verdicts: their figures, and the errors of their frames from trajectory.txt and the ground truth in their recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from trihedron.comparison import other_programs
from trihedron.comparison.run_tables import FIGURES
from trihedron.comparison.verdicts import Column, Sample
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.types import F64
from trihedron.pipeline.record.trajectories import read_trajectory
from trihedron.pipeline.run.metrics import I64, frame_errors
from trihedron.pipeline.run.results import TRAJECTORY

ERRORS = {"ATE mm": "ate_rmse_m", "RPE 1 s mm": "rpe_second_rmse_m", "RPE 1 s deg": "rpe_second_rmse_deg"}  # column -> name in the metrics
COLUMNS = {name: Column(figure.decimals, figure.more, 2 if name in ERRORS else 0) for name, figure in FIGURES.items()}


def paired_samples(first: Path, second: Path, figures: tuple[Mapping[str, float], Mapping[str, float]]) -> tuple[Sample, Sample]:
    """Return two runs of the same data, by their folders and figures, as samples; with the errors of frames where both have the same frames."""
    (stamps_a, errors_a, fps), (stamps_b, errors_b, _) = errors_of_run(first), errors_of_run(second)
    if not np.array_equal(stamps_a, stamps_b):
        errors_a, errors_b = {}, {}
    return Sample(figures[0], errors_a, round(fps)), Sample(figures[1], errors_b, round(fps))


def errors_of_run(folder: Path) -> tuple[I64, dict[str, F64], float]:
    """Return the stamps of a run's frames, the error of each by column, and the frames a second; no errors where the folder has not all it takes."""
    for reference in other_programs.references([(folder, {})]):
        try:
            found = frame_errors(read_trajectory(folder / TRAJECTORY), reference.truth, reference.fps, reference.stamps_ns)
        except DataError:
            continue
        errors = {column: FIGURES[column].factor * found[name] for column, name in ERRORS.items() if name in found}
        return reference.stamps_ns, errors, reference.fps
    return np.zeros(0, np.int64), {}, 30.0
