"""Rotation error against frame for each run of a sweep over estimators, and the sphere of directions of one frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from trihedron.datasets.trajectories import attached_truth
from trihedron.pipeline.errors import DataError, RecordingError
from trihedron.pipeline.geometry import nearest_pairs, nearest_rotation, rotation_angle_deg
from trihedron.pipeline.recording import Recording
from trihedron.pipeline.types import F64, ManhattanFrame, Trajectory
from trihedron.plugins.numerics.cube_symmetry import nearest_equivalent
from trihedron.tools.arguments import table

RECORDING, ERRORS_PNG = "run.mcap", "rotation_error.png"
LARGEST_DIFFERENCE_NS = 20_000_000
CANDIDATES, INLIER_DEG = 30, 5.0  # frames tried as the world–Manhattan rotation; residual of those that are averaged


def compare(folder: Path, out: Path, sphere: int | None) -> str:
    """The table of all runs below `folder`; pictures go to `out`. Raises DataError when nothing can be compared."""
    runs = {}
    for path in sorted(folder.glob(f"*/{RECORDING}"), key=lambda p: (len(p.parent.name), p.parent.name)):
        recording = Recording(path)
        if "manhattan" in recording.topics:
            runs[f"{path.parent.name} {_config(recording)['manhattan']['plugin']}"] = recording
    if not runs:
        raise DataError(str(folder), "holds no runs with a Manhattan frame", "make them with trihedron run -m experiment=rotation_family replay=FILE")
    out.mkdir(parents=True, exist_ok=True)
    errors = {name: rotation_errors(recording) for name, recording in runs.items()}
    _plot_errors(errors, out / ERRORS_PNG)
    written = [out / ERRORS_PNG]
    if sphere is not None:
        written.append(out / f"sphere_{sphere}.png")
        _plot_sphere(runs, sphere, written[-1])
    rows: list[list[str]] = [["run", "frames", "claimed", "within 1°", "median (deg)", "p95 (deg)", "max (deg)"]]
    for name, values in errors.items():
        known = values[np.isfinite(values[:, 1]), 1]
        numbers = [np.median(known), np.percentile(known, 95), known.max()] if len(known) else []
        shares = [f"{len(known) / len(values):.3f}", f"{np.mean(values[:, 1] <= 1.0):.3f}"] if len(values) else ["-", "-"]
        rows.append([name, str(len(values)), *shares, *([f"{x:.3f}" for x in numbers] or ["-"] * 3)])
    return "\n".join([table(rows, "lrrrrrr"), *(str(path) for path in written)])


def rotation_errors(recording: Recording) -> F64:
    """(n, 2) frame number and residual (deg) of `R_world_camera R_camera_manhattan` against the one constant rotation that fits the frames best;
    NaN where no Manhattan frame was claimed. Raises DataError without ground truth."""
    truth: Trajectory | None = attached_truth(recording.attachments, str(recording.path))
    if truth is None:
        raise DataError(str(recording.path), "holds no ground truth", "record a data set that has one")
    found: list[ManhattanFrame] = [v for v in recording.values("manhattan") if isinstance(v, ManhattanFrame)]
    pairs = nearest_pairs(np.array([v.stamp_ns for v in found], np.int64), truth.stamps_ns, LARGEST_DIFFERENCE_NS)
    frames = [found[i] for i, _ in pairs]
    worlds = [[truth.poses[j, :3, :3] @ R for R in found[i].rotations] if found[i].supported else [] for i, j in pairs]
    claimed = [rotations for rotations in worlds if rotations]
    if not claimed:
        return np.array([[frame.index, np.nan] for frame in frames]).reshape(-1, 2)
    tried = [rotations[0] for rotations in claimed[:: max(len(claimed) // CANDIDATES, 1)]]
    world = min(tried, key=lambda R: float(np.median([_residual(rotations, R) for rotations in claimed])))
    near = [nearest_equivalent(R, world) for rotations in claimed for R in rotations]
    world = nearest_rotation(sum((R for R in near if rotation_angle_deg(world.T @ R) <= INLIER_DEG), np.zeros((3, 3))))
    return np.array([[frame.index, _residual(rotations, world) if rotations else np.nan] for frame, rotations in zip(frames, worlds)])


def _residual(rotations: list[F64], world: F64) -> float:
    return min(rotation_angle_deg(world.T @ nearest_equivalent(R, world)) for R in rotations)


def _config(recording: Recording) -> Any:
    return yaml.safe_load(recording.metadata["config"])


def _plot_errors(errors: dict[str, F64], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(9, 4), layout="constrained")
    for name, values in errors.items():
        axes.plot(values[:, 0], values[:, 1], marker=".", markersize=3, linewidth=1, label=name)
    axes.set_yscale("log")
    axes.set_xlabel("frame")
    axes.set_ylabel("rotation error (deg)")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def _plot_sphere(runs: dict[str, Recording], frame: int, path: Path) -> None:
    """The half sphere in Lambert's equal-area projection, opposite directions folded together, seen along the camera's axis."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    first = next(iter(runs.values()))
    source = _config(first).get("replay")
    values = {topic: _value(Recording(source) if source else first, topic, frame) for topic in ("normals", "planes", "segments")}
    if all(value is None for value in values.values()):
        raise RecordingError(str(source or first.path), f"has no features of frame {frame}", "give the number of a recorded frame")
    figure, axes = pyplot.subplots(figsize=(7, 7), layout="constrained")
    axes.add_patch(pyplot.Circle((0, 0), 1.0, fill=False, color="0.5"))
    if values["normals"] is not None:
        x, y = _disc(values["normals"].normals[::4, ::4].reshape(-1, 3))
        axes.scatter(x, y, s=2, color="0.7", label="normals")
    if values["planes"] is not None:
        planes = values["planes"]
        x, y = _disc(planes.coefficients[:, :3])
        axes.scatter(x, y, s=np.sqrt(planes.pixels) + 10.0, marker="s", alpha=0.5, color="tab:blue", label="planes")
    if values["segments"] is not None:
        ends = values["segments"].endpoints_m
        x, y = _disc(ends[:, 1] - ends[:, 0])
        axes.scatter(x, y, s=14, marker="x", linewidth=0.8, color="tab:orange", label="lines")
    for number, (name, recording) in enumerate(runs.items()):
        found = _value(recording, "manhattan", frame)
        if found is not None and len(found.rotations):
            label = name if found.supported else f"{name} (not claimed)"
            directions = np.swapaxes(found.rotations, 1, 2).reshape(-1, 3)
            x, y = _disc(directions)
            axes.scatter(x, y, s=90 + 45 * number, facecolors="none", edgecolors=f"C{number + 2}", label=label)
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.legend(fontsize=8, loc="lower left")
    axes.set_title(f"directions of frame {frame}, opposite ones folded", fontsize=10)
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def _disc(directions: F64) -> F64:
    """(n, 3) -> (2, m) points in the unit disc of those that are finite; y down as in the image, hence drawn upside down."""
    known = directions[np.isfinite(directions).all(axis=1)].astype(np.float64)
    known = known / np.maximum(np.linalg.norm(known, axis=1, keepdims=True), 1e-12)
    known = np.where(known[:, 2:] > 0.0, -known, known)
    return np.asarray((known[:, :2] / np.sqrt(1.0 - known[:, 2:])).T * [[1.0], [-1.0]])


def _value(recording: Recording, topic: str, frame: int) -> Any:
    if topic not in recording.topics:
        return None
    return next((value for value in recording.values(topic) if value.index == frame), None)
