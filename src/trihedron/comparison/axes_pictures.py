"""The pictures of a comparison of estimators: errors against frame, and the sphere of one frame's directions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trihedron.comparison.axes import FALSE_DEG, RIGHT_DEG, Run, config_of, in_view
from trihedron.pipeline.app.recorded_run import composed_run
from trihedron.pipeline.app.recorded_values import frames_of, references_of
from trihedron.pipeline.core.config import make_plugin
from trihedron.pipeline.core.errors import TrihedronError
from trihedron.pipeline.core.files import new_file
from trihedron.pipeline.core.lie import rotation_angle_deg
from trihedron.pipeline.core.types import F64, Normals
from trihedron.pipeline.record.reader import Recording
from trihedron.plugins.shared.manhattan_frames_kernels import nearest_equivalent

AXIS_COLORS = ("tab:red", "tab:green", "tab:blue")
NORMAL_STEP = 3  # every third normal is drawn, in both directions of the grid
LEAST_DEG, MOST_DEG = 1e-2, 50.0  # of the errors' axis
COLUMNS = 4
RING: dict[str, Any] = {"marker": "o", "markersize": 13, "fillstyle": "none", "markeredgewidth": 1.5}
MARKERS = "os^D"  # of several frames


def errors_figure(runs: Sequence[Run], errors_deg: Sequence[F64], path: Path) -> None:
    """A row for each estimator: its error (n,) by frame, false claims in red, frames without a claim marked below. Writes a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 0.6 + 1.1 * len(runs)), layout="constrained")
    axes: Any = np.atleast_1d(figure.subplots(len(runs), 1, sharex=True, sharey=True))
    for run, errors, ax in zip(runs, errors_deg, axes):
        numbers = np.array([value.index for value in run.found])
        error = np.clip(errors, LEAST_DEG, MOST_DEG)
        false, silent = error > FALSE_DEG, np.isnan(error)
        ax.plot(numbers, error, ".-", color="tab:blue", markersize=2, linewidth=0.7)
        ax.plot(numbers[false], error[false], "o", color="tab:red", markersize=3, label="more than 3° off")
        ax.plot(numbers[silent], np.full(silent.sum(), 0.04), "|", color="0.45", transform=ax.get_xaxis_transform(), label="no claim")
        ax.axhline(RIGHT_DEG, color="0.6", linewidth=0.7, linestyle="--")
        ax.set_yscale("log")
        ax.set_ylim(LEAST_DEG, MOST_DEG)
        ax.set_yticks([0.1, 1.0, 10.0], ["0.1", "1", "10"])
        ax.grid(alpha=0.25)
        ax.set_title(run.name, fontsize=9, loc="left", pad=2)
    axes[0].legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False, borderaxespad=0.0)
    axes[-1].set_xlabel("frame")
    figure.supylabel("rotation error (°)", fontsize=10)
    with new_file(path) as new:
        figure.savefig(new, dpi=100)


def sphere_figure(runs: Sequence[Run], world: F64, frame: int, path: Path) -> None:
    """A half sphere for each estimator, in Lambert's equal-area projection along the camera's axis, opposite directions folded together: normals,
    planes and lines of the frame, the true axes and those it estimates. Writes a PNG."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    count = min(COLUMNS, len(runs))
    rows = -(-len(runs) // count)
    figure = Figure(figsize=(3.6 * count, 3.75 * rows + 0.5), layout="constrained")
    grid: Any = np.atleast_1d(figure.subplots(rows, count)).ravel()
    features = _features(runs[0].recording, frame)
    for run, ax in zip(runs, grid):
        row = next((i for i, value in enumerate(run.found) if value.index == frame), None)
        _draw_directions(ax, features)
        title = f"{run.name}: nothing"
        if row is not None:
            truth = run.R_world_camera[row].T @ world
            ax.plot(*_disc(truth.T), "+", color="black", markersize=16, markeredgewidth=1.2, label="true axes")
            title = f"{run.name}: {_draw_axes(ax, run, row, truth)}"
        ax.set_title(title, fontsize=9)
    for ax in grid:
        ax.set_axis_off()
        ax.set_aspect("equal")
        ax.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05))
    handles = [*grid[0].get_legend_handles_labels()[0], Line2D([], [], **RING, color="tab:green", linestyle="", label="axes estimated")]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, frameon=False)
    figure.suptitle(f"directions of frame {frame}, opposite ones folded", fontsize=11)
    with new_file(path) as new:
        figure.savefig(new, dpi=100)


def _draw_directions(ax: Any, features: dict[str, Any]) -> None:
    """Normals as dots, planes as squares by their size, lines as crosses."""
    angles = np.linspace(0.0, 2.0 * np.pi, 181)
    ax.plot(np.cos(angles), np.sin(angles), color="0.5", linewidth=0.8)
    normals, planes, segments = features["normals"], features["planes"], features["segments"]
    if normals is not None:
        x, y = _disc(normals.normals[::NORMAL_STEP, ::NORMAL_STEP].reshape(-1, 3))
        ax.scatter(x, y, s=3, color="0.5", alpha=0.4, linewidth=0, label="normals")
    if segments is not None:
        ends = segments.endpoints_m
        ax.scatter(*_disc(ends[:, 1] - ends[:, 0]), s=20, marker="x", linewidth=0.8, color="tab:orange", label="lines")
    if planes is not None:
        x, y = _disc(planes.coefficients[:, :3])
        ax.scatter(x, y, s=8.0 + 0.15 * np.sqrt(planes.pixels), marker="s", alpha=0.8, color="tab:purple", linewidth=0, label="planes")


def _draw_axes(ax: Any, run: Run, row: int, truth: F64) -> str:
    """Rings around the axes of each frame in view, coloured as the nearest true axis; returns what was claimed and how far off that is."""
    value, errors = run.found[row], []
    for number, R in enumerate(in_view(value)[0]):
        named = nearest_equivalent(R, truth)
        errors.append(rotation_angle_deg(truth.T @ named))
        for axis, color in zip(named.T, AXIS_COLORS):
            ax.plot(*_disc(axis[None]), **(RING | {"marker": MARKERS[number % len(MARKERS)]}), linestyle="", color=color)
    if not value.supported:
        return "no claim"
    return f"{len(errors)} frames, nearest {min(errors):.2f}°" if len(errors) > 1 else f"{errors[0]:.2f}°" if errors else "nothing in view"


def _disc(directions: F64) -> F64:
    """(n, 3) -> (2, m) points in the unit disc of those that are finite; y down as in the image, hence drawn upside down."""
    known = directions[np.isfinite(directions).all(axis=1)].astype(np.float64)
    known = known / np.maximum(np.linalg.norm(known, axis=1, keepdims=True), 1e-12)
    known = np.where(known[:, 2:] > 0.0, -known, known)
    return np.asarray((known[:, :2] / np.sqrt(1.0 - known[:, 2:])).T * [[1.0], [-1.0]])


def _features(recording: Recording, frame: int) -> dict[str, Any]:
    """Normals, planes and segments of a frame, from the run or what it replayed; the normals computed again where they were not recorded."""
    source = config_of(recording).get("replay")
    sources = [recording, *([Recording(source)] if source and Path(source).exists() else [])]
    found: dict[str, Any] = {}
    for topic in ("normals", "planes", "segments"):
        values = (value for file in sources if topic in file.topics for value in file.values(topic) if value.index == frame)
        found[topic] = next(values, None)
    if found["normals"] is None:
        found["normals"] = _normals_again(sources[-1], frame)
    return found


def _normals_again(recording: Recording, frame: int) -> Normals | None:
    """By the recording's own normals plugin from its images; None where these are not at hand."""
    try:
        image = frames_of(recording)(references_of(recording)[frame])
        normals: Normals | None = make_plugin("normals", composed_run(recording).normals)(frame=image) if image is not None else None
    except TrihedronError:
        return None
    return normals
