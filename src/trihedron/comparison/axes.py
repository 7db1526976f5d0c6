"""Errors of the Manhattan axes of several runs of the same data, in one world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trihedron.pipeline.core.errors import DataError
from trihedron.pipeline.core.files import one_line_errors, parse_yaml
from trihedron.pipeline.core.geometry import nearest_pairs, nearest_rotation
from trihedron.pipeline.core.lie import log_so3
from trihedron.pipeline.core.types import F64, ManhattanFrame
from trihedron.pipeline.record.mcap_file import RECORDING
from trihedron.pipeline.record.reader import Recording
from trihedron.pipeline.record.trajectories import attached_truth
from trihedron.pipeline.run.result_files import read_results
from trihedron.plugins.shared.manhattan_frames_kernels import CUBE, nearest_equivalent

TIMING, ERRORS_PNG = "timing.json", "rotation_error.png"
LARGEST_DIFFERENCE_NS = 20_000_000
CANDIDATES, INLIER_DEG = 20, 5.0  # claims of a run tried as the truth; residual of those that are averaged
RIGHT_DEG, FALSE_DEG = 1.0, 3.0


@dataclass(frozen=True)
class Run:
    """One estimator over the recording. `T_world_camera` holds the true rotations (n, 3, 3) of the frames in `found`."""

    name: str
    recording: Recording
    found: list[ManhattanFrame]
    R_world_camera: F64
    p50_ms: float  # NaN where it was not timed

    @cached_property
    def claims(self) -> tuple[NDArray[np.int64], F64, F64]:
        """(m,) rows of `found` that claim a frame, one for each frame in view, (m, 3, 3) R_world_manhattan by each, and its covariance in the
        world."""
        rows = [(i, R, C) for i, value in enumerate(self.found) if value.supported for R, C in zip(*in_view(value))]
        number, (rotations, covariance) = np.array([i for i, _, _ in rows], np.int64), (np.array([row[k] for row in rows]) for k in (1, 2))
        camera = self.R_world_camera[number]
        return number, camera @ rotations.reshape(-1, 3, 3), camera @ covariance.reshape(-1, 3, 3) @ np.swapaxes(camera, 1, 2)

    def errors_deg(self, world: F64) -> F64:
        """(n,) error of each frame, NaN where none was claimed."""
        errors, (rows, rotations, _) = np.full(len(self.found), np.inf), self.claims
        np.minimum.at(errors, rows, residuals_deg(rotations, world))
        return np.asarray(np.where(np.isfinite(errors), errors, np.nan))

    def nees(self, world: F64) -> float:
        """Median NEES of the claims that are not false, of three degrees of freedom; NaN without any."""
        squares = []
        for R, covariance in zip(*self.claims[1:]):
            phi = log_so3(nearest_equivalent(world, R) @ R.T)
            if np.linalg.norm(phi) <= np.radians(FALSE_DEG):
                squares.append(float(phi @ np.linalg.solve(covariance, phi)))
        return float(np.median(squares)) if squares else float("nan")


def draw(runs: Sequence[Run], world: F64, errors_deg: Sequence[F64], folder: Path, prefix: str = "", frame: int | None = None) -> list[Path]:
    """Draw the errors (n,) of each run against frame, and the sphere of a frame, by default the middle one; returns the files. Raises DataError for
    an unknown one."""
    from trihedron.comparison.axes_pictures import errors_figure, sphere_figure

    numbers = [value.index for value in runs[0].found]
    frame = numbers[len(numbers) // 2] if frame is None else frame
    if frame not in numbers:
        raise DataError(str(folder), f"there is no frame {frame}", f"give one of {numbers[0]}..{numbers[-1]}")
    written = [folder / f"{prefix}{name}" for name in (ERRORS_PNG, f"sphere_{frame}.png")]
    errors_figure(runs, errors_deg, written[0])
    sphere_figure(runs, world, frame, written[1])
    return written


def read_runs(place: Path, folders: Sequence[Path]) -> list[Run]:
    """The runs of folders, those without a recording left out. Raises DataError, naming `place`, without any, or without ground truth."""
    runs: list[Run] = []
    for path in (folder / RECORDING for folder in folders):
        recording = Recording(path) if path.exists() else None
        if recording is not None and "manhattan" in recording.topics:
            runs.append(_run(recording, [run.name for run in runs]))
    runs = [run for run in runs if run.found]
    if not runs:
        cure = "make them with: trihedron ablate RUN.mcap 'manhattan=*' feedback=recorded out=FOLDER"
        raise DataError(str(place), "holds no runs with a Manhattan frame and ground truth", cure)
    return runs


def _run(recording: Recording, taken: list[str]) -> Run:
    plugin: str = config_of(recording)["manhattan"]["plugin"]
    name = plugin if plugin not in taken else f"{plugin} {recording.path.parent.name}"
    truth = attached_truth(recording.attachments, str(recording.path))
    if truth is None:
        raise DataError(str(recording.path), "holds no ground truth", "record a data set that has one")
    values = [v for v in recording.values("manhattan") if isinstance(v, ManhattanFrame)]
    pairs = nearest_pairs(np.array([v.stamp_ns for v in values], np.int64), truth.stamps_ns, LARGEST_DIFFERENCE_NS)
    timing = recording.path.with_name(TIMING)
    stage = (read_results(timing).get("stages") or {}).get("manhattan") or {}
    p50_ms = float(stage.get("p50_ms") or np.nan)
    return Run(name, recording, [values[i] for i, _ in pairs], truth.poses[pairs[:, 1], :3, :3], p50_ms)


def config_of(recording: Recording) -> Any:
    """The composed configuration that made it. Raises DataError."""
    with one_line_errors(f"{recording.path}: config"):
        return parse_yaml(recording.metadata["config"])


def in_view(value: ManhattanFrame) -> tuple[F64, F64]:
    """(k, 3, 3) rotations and covariances of the frames that are seen, not only remembered."""
    seen = value.inliers.sum(axis=1) > 0
    return value.rotations[seen], value.covariance[seen]


def residuals_deg(rotations: F64, reference: F64) -> F64:
    """(n,) angle of (n, 3, 3) to the nearest of the 24 names of the reference (3, 3)."""
    traces = np.einsum("nij,cij->nc", reference.T @ rotations, CUBE).max(axis=1, initial=-1.0)
    return np.asarray(np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0))))


def common_world(runs: Sequence[Run]) -> F64:
    """(3, 3) R_world_manhattan: of claims spread over all runs the one with the least mean residual, larger ones cut off, each run alike; then the
    mean of the claims near it. Raises DataError when nothing was claimed."""
    claims = [run.claims[1] for run in runs if len(run.claims[1])]
    if not claims:
        raise DataError(str(runs[0].recording.path), "no run claims a Manhattan frame", "try another sequence")
    tried = [R for rotations in claims for R in rotations[:: max(len(rotations) // CANDIDATES, 1)]]
    cut = [np.mean([np.minimum(residuals_deg(rotations, R), INLIER_DEG).mean() for rotations in claims]) for R in tried]
    world = tried[int(np.argmin(cut))]
    total = np.zeros((3, 3))
    for rotations in claims:
        near = rotations[residuals_deg(rotations, world) <= INLIER_DEG]
        total += sum((nearest_equivalent(R, world) for R in near), np.zeros((3, 3))) / len(rotations)
    return nearest_rotation(total)
