"""Errors of the surface and the building of a run, by the true ones of its data set, for tables beside those of single stages: less is better."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison.surface_errors import evaluate_files
from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import file_sha256, write_file
from trihedron.pipeline.run.result_files import read_results
from trihedron.plugins.surface.files import SURFACE, SURFACE_ERRORS

BUILDING = {  # column -> key of the figures, the value where it is perfect, factor
    "walls mm": ("wall_m", 0.0, 1e3),
    "missed rooms %": ("room_recall", 1.0, 100.0),
    "false rooms %": ("room_precision", 1.0, 100.0),
}
COLUMNS = {"surface mm": 2, "missed surface %": 1, "walls mm": 1, "missed rooms %": 0, "false rooms %": 0}  # -> decimals
Measures = dict[str, float]  # error by column


def of_folds(stages: Iterable[str], runs: Sequence[Path], source: Path) -> list[Measures]:
    """Return for each run folder the measures of those of its folds that are among the stages; `source` is the recording that all were computed
    from. Equal surfaces are judged once. A fold without a truth has none, and a line has the reason."""
    found: list[Measures] = [{} for _ in runs]
    judged: dict[str, dict[str, Any]] = {}  # SHA-256 of a surface -> its figures
    for stage in stages:
        for run, measures in zip(runs, found):
            try:
                if stage == "surface" and (run / SURFACE).exists():
                    digest = file_sha256(run / SURFACE)
                    judged[digest] = figures = judged[digest] if digest in judged else evaluate_files(run / SURFACE, source)
                    measures |= of_surface_figures(_write_figures(run, figures))
                elif stage == "building":
                    measures |= of_building(run, source.parent)
            except DataError as error:
                print(f"{stage} of {run} is not judged: {error}", file=sys.stderr)
    return found


def judge_surface(run: Path, recording: Path) -> dict[str, Any]:
    """Judge the surface of a run folder by the truth of a recording's data set, and write surface.json. Raises DataError."""
    return _write_figures(run, evaluate_files(run / SURFACE, recording))


def _write_figures(run: Path, figures: dict[str, Any]) -> dict[str, Any]:
    """Write the figures of a run's surface to surface.json, and return them."""
    write_file(run / SURFACE_ERRORS, json.dumps(figures, indent=2) + "\n")
    return figures


def of_surface(run: Path) -> Measures:
    """Return the measures of a run folder's surface; empty where it was not judged."""
    return of_surface_figures(figures) if (figures := read_results(run / SURFACE_ERRORS)) else {}


def of_surface_figures(figures: Mapping[str, Any]) -> Measures:
    """`surface mm`: mean distance of the mesh from the true surface. `missed surface %`: share of the seen true surface farther than 5 cm from it."""
    whole = figures["parts"]["all"]
    found = {"surface mm": (0.0, 1e3, whole["mean_m"]), "missed surface %": (100.0, -100.0, whole["within_5_cm"])}
    return {name: offset + factor * value for name, (offset, factor, value) in found.items() if value is not None}


def of_building(run: Path, beside: Path | None = None) -> Measures:
    """`walls mm`: median offset of walls from the true ones. `missed rooms %`, `false rooms %`: of the true ones, of those that are found.
    `beside` has the trajectory where the run folder has none. Raises DataError where the data set has no true plan."""
    from trihedron.comparison.building_errors import plan_errors_of_run

    figures = plan_errors_of_run(run, beside=beside)
    found = {name: factor * abs(figures[key] - perfect) for name, (key, perfect, factor) in BUILDING.items()}
    return {name: value for name, value in found.items() if np.isfinite(value)}
